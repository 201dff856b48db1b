"""What a side camera and a laser would measure; knows geometry and nothing of parking."""
