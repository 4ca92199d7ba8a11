"""What MAVSDK 4's documentation promises about a vehicle, as cases that run against any peer.

Written from the docstrings of `mavsdk` and `mavsdk.asyncio` and from PX4's user guide, not from `sim_bridge`. A case
asks for something and waits until telemetry shows that it happened, so that a peer which only acknowledges fails it.
"""
