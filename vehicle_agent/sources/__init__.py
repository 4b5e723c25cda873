"""Where the items come from that a `Pipeline` is fed with."""
