"""What theory says of parking searches, against what the package's planners and worlds do."""
