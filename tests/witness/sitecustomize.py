"""Python imports this module at its start: in a subprocess of a test, it installs the recorder of the HALs."""

import os
import sys

if "ATALANTE_WITNESS" in os.environ:
    import hal_witness

    hal_witness.install()
    # Hide asammdf, as in an installation without `dev`, because python-can would import it, which is slow.
    sys.modules["asammdf"] = None  # type: ignore[assignment]
