"""Bounds on what any agent can reach: the clairvoyant oracle, exact solutions of small lots."""
