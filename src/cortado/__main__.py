"""The entry point of ``cortado`` and ``python -m cortado``, which sets signal handlers before the slow imports."""

from cortado.files import terminal as interruption


def main() -> None:
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
