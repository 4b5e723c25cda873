"""What runs the system: the `gnd` command, the local fleet launcher and its configuration files."""
