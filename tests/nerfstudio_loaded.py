"""Importing this loads nerfstudio's methods, in a second in place of six.

nerfstudio asks for the whole stack, with its lines of source, once for each external method that it
lists (`inspect.stack`). Beneath pytest that is long; a thread's own is short.
"""

import importlib
from concurrent.futures import ThreadPoolExecutor

with ThreadPoolExecutor(1) as thread:
    thread.submit(importlib.import_module, "nerfstudio.configs.method_configs").result()
