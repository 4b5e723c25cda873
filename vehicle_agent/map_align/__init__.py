"""Two maps, or a map and a drive, into one frame: Gaussians onto Gaussians, or a refusal that says why."""
