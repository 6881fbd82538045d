"""The program: the command line from its first import on, and what an interrupt leaves of it."""

import signal
import sys
from importlib import import_module

INTERRUPTED = 130


def main() -> int:
    """Run the command line; an interrupt is one line and exit code 130, whenever it comes."""
    try:
        return int(import_module(".cli", __package__).main())
    except KeyboardInterrupt:  # while the command line itself is imported
        sys.stderr.write("pathspace-graph: interrupted\n")
        return INTERRUPTED
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # nothing is left to be interrupted but the cleaning up


if __name__ == "__main__":
    sys.exit(main())
