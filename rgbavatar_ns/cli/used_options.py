"""Options that count for some of what a command does: one that changes nothing is told."""

from collections.abc import Collection, Mapping

from rgbavatar_ns.errors import UserError


def require_used(
    choice: str, chosen: str, used_by: Mapping[str, Collection[str]], given: Collection[str]
) -> None:
    """Raise UserError for an option that is given, but not used by what was chosen.

    choice: the option that chooses, such as "show". used_by: what each option counts for.
    """
    for name, counts_for in used_by.items():
        if name in given and chosen not in counts_for:
            others = " or ".join(f"--{choice} {other}" for other in counts_for)
            raise UserError(
                f"--{name} changes nothing of --{choice} {chosen}.",
                f"Leave it out, or take {others}.",
            )
