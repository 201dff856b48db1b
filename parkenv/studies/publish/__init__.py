"""Folders of trained models for the Hugging Face Hub."""
