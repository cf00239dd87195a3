"""The process of the command ``cortado``, also ``python -m cortado``: ready for signals before anything large is
imported."""

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
