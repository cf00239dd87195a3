"""Start the command ``cortado`` or ``python -m cortado``: signal handlers are set before large imports."""

from cortado.files import terminal as interruption


def main() -> None:
    """Run the command line; always exits."""
    interruption.leave_at_once()
    from cortado.files.terminal import steady_streams

    steady_streams()
    from cortado import cli

    try:
        cli.main()
    finally:
        interruption.finish()


if __name__ == "__main__":
    main()
