"""The parts of the PX4-style autopilot: failsafe, arming checks, navigation, position control, sticks, setpoints."""
