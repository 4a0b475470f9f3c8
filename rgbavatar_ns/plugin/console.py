"""Lines for the user, upon nerfstudio's console."""

from nerfstudio.utils.rich_utils import CONSOLE


def say(line: str) -> None:
    """Print a line as it is, however long and with any brackets."""
    CONSOLE.print(line, highlight=False, soft_wrap=True, markup=False)
