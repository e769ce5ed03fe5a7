"""Loads nbval, which runs the notebooks, without the checks that take two seconds to import.

nbval validates notebooks with jsonschema, which builds a grammar of internationalised addresses as
soon as it is imported if rfc3987_syntax is installed. The format of notebooks has none of these.
"""

import sys

sys.modules["rfc3987_syntax"] = None  # an ImportError, which jsonschema expects
pytest_plugins = ["nbval.plugin"]
