"""`python -m parkenv`."""

from parkenv.cli import main

if __name__ == "__main__":
    main()
