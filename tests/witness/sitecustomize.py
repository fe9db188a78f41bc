"""What Python imports as it starts: in a process that a test started, the witness of its HALs."""

import os
import sys

if "ATALANTE_WITNESS" in os.environ:
    import hal_witness

    hal_witness.install()
    # As in an installation without `dev`: python-can imports it if it is there, which takes longer than all the rest.
    sys.modules["asammdf"] = None  # type: ignore[assignment]
