"""What Python imports as it starts: in a process that a test started, the witness of its HALs."""

import os

if "ATALANTE_WITNESS" in os.environ:
    import hal_witness

    hal_witness.install()
