"""What ties a vehicle to the cloud: tiles come in, reports go out, telemetry; alone here are bus, cache and outbox."""
