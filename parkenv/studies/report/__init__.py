"""What a report page needs of a run: its folder, and recordings of its searches, drives and days."""
