"""What the project is made with, not shipped with it."""
