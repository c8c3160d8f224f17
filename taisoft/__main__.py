"""`python -m taisoft` is the command `taisoft`."""

import sys

from taisoft.cli import main

sys.exit(main())
