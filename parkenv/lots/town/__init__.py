"""Towns from OpenStreetMap: streets, kerbs, car parks, garages, their rules, and what attracts demand."""
