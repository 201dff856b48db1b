"""The command `parkenv`, and `python -m parkenv`."""

from parkenv.files.command_process import end_on_signals


def main() -> None:
    """Entry point: signals end the command without a traceback, also while it imports its modules."""
    end_on_signals()
    from parkenv.files.command_process import distrust_working_folder

    distrust_working_folder()
    from parkenv.cli import main as run

    run()


if __name__ == "__main__":
    main()
