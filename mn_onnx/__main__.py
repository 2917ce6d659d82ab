"""``python -m mn_onnx``: the command line."""

import sys

from mn_onnx.cli import main

sys.exit(main())
