"""`companion monitor`: every vehicle on the network in a terminal, from Zenoh alone."""
