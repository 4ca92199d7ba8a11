"""The companion safety service: tracks what moves, flies to the target, touches nothing.

A pure brain (``tracking``, ``policy``, ``safety``, ``pilot``), sans-I/O wires (``link``) and a thin asyncio
shell (``service``). Inside the brain: local ENU, SI units, float64, integer nanoseconds of the vehicle's clock.
"""

__version__ = "0.1.0"
