"""One self-contained HTML page on the results of a command, with its searches and drives to watch again."""
