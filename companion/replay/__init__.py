"""`companion replay`: the recorded calls again, through the brain of this version."""
