"""`companion doctor`: looks at autopilot, sensors and this machine, and says what a flight would meet."""
