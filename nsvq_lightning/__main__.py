"""``python -m nsvq_lightning``: the ``nsvq`` command."""

import sys

from nsvq_lightning.commands.main import main

if __name__ == "__main__":
    sys.exit(main())
