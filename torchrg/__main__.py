"""``python -m torchrg``."""

import sys

from torchrg.cli import main

if __name__ == "__main__":
    sys.exit(main())
