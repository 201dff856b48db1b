"""A self-contained HTML page on the results of a run: data, tables, figures, scripts and style sheet."""
