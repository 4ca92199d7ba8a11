"""Reading logs of flights: what they hold, as numbers, tables and pictures."""
