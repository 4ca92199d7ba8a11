"""`companion demo`: the simulator and the daemon as separate processes, an operator on MAVSDK, a table, a picture."""
