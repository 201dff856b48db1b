"""The pictures that commands and reports write."""
