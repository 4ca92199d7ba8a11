"""The live page: what the daemon already knows, drawn in a browser; nothing is computed while nobody watches."""
