"""The command `parkenv`, and `python -m parkenv`."""

import signal


def main() -> None:
    """Entry point: Ctrl-C ends the command without a traceback, also while it imports its modules."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from parkenv.files.working_folder import distrust_working_folder

    distrust_working_folder()
    from parkenv.cli import main as run

    run()


if __name__ == "__main__":
    main()
