"""Changes within an MCAP file whose checksums stay right: others are refused before a message is looked at."""

import io
from collections.abc import Mapping
from random import Random

from fuzz_mutators import Mutate, bytes_mutated, text_mutated
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, Writer

_TIMES = (0, 1, 2**31, 2**62, 2**63 - 1, 2**63, 2**64 - 1)


def mcap_mutated(messages: Mapping[str, Mutate]) -> Mutate:
    """A mutator: one to three messages change, their times, a channel, or the header; one time of four only bytes.

    Args:
        messages: by name of a schema, how its messages change; others change as bytes.
    """

    def mutate(data: bytes, rng: Random) -> bytes:
        if rng.randrange(4) == 0:
            return bytes_mutated(data, rng)
        try:
            return _written_anew(data, rng, messages)
        except Exception:  # damaged already: whatever the library stumbles over
            return bytes_mutated(data, rng)

    return mutate


def _written_anew(data: bytes, rng: Random, messages: Mapping[str, Mutate]) -> bytes:
    found = list(NonSeekingReader(io.BytesIO(data), record_size_limit=1 << 20).iter_messages())
    notes = list(NonSeekingReader(io.BytesIO(data), record_size_limit=1 << 20).iter_metadata())
    changed = {rng.randrange(len(found)) for _ in range(rng.choice((0, 1, 1, 1, 3)))} if found else set()
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE)
    writer.start()
    schemas, channels = dict[int, int](), dict[int, int]()
    other = rng.randrange(8)
    for number, (schema, channel, message) in enumerate(found):
        name = schema.name if schema is not None else ""
        if schema is not None and schema.id not in schemas:
            text = text_mutated(schema.data, rng) if other == 0 else schema.data
            schemas[schema.id] = writer.register_schema(name, schema.encoding, text)
        if channel.id not in channels:
            topic = rng.choice(found)[1].topic if other == 1 else channel.topic
            channels[channel.id] = writer.register_channel(
                topic, channel.message_encoding, schemas.get(channel.schema_id, 0), channel.metadata
            )
        body, log_time = message.data, message.log_time
        if number in changed:
            body = messages.get(name, bytes_mutated)(body, rng)
        if number in changed and rng.randrange(4) == 0:
            log_time = rng.choice((*_TIMES, rng.choice(found)[2].log_time))
        for _ in range(2 if number in changed and rng.randrange(8) == 0 else 1):
            writer.add_message(channels[channel.id], log_time, body, message.publish_time, message.sequence)
    for note in notes:
        writer.add_metadata(note.name, _texts_mutated(note.metadata, rng) if other == 2 else note.metadata)
    writer.finish()
    return stream.getvalue()


def _texts_mutated(values: Mapping[str, str], rng: Random) -> dict[str, str]:
    chosen = rng.choice(sorted(values)) if values else ""
    return {
        name: text_mutated(text.encode(), rng).decode("utf-8", "replace") if name == chosen else text
        for name, text in values.items()
    }
