"""The 270° laser scanner."""
