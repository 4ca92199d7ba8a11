"""`companion explain`: in words why the vehicle did what it did at one moment of a recorded flight."""
