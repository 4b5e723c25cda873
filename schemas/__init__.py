"""What is said on the bus and written to drives: keys, messages, limits.

`keys` the one table of key expressions; `tiles`, `changes`, `updates`, `traffic` the messages, each a frozen value with
`encode` and `decode`; `drive` and `drive_mcap` recorded drives; `limits` how large anything may be; `errors` what may
be wrong. `*.proto` are the sources of `generated` (`python -m gnd.schemas.generate`).
"""
