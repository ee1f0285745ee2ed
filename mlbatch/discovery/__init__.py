"""Discovery: the sensors of a session, found in its recordings.

`discover` reads the `first_seconds` (`sampler`), matches packets with `calibrations`
(`match`), places the sensors on the body (`extrinsics`) and assigns later packets to them
(`router`). `inspect` is a view of its result.
"""
