"""The lots that come with the package, as files; `python -m parkenv.lots.build` makes them anew."""
