"""Options that are given twice: refused, where of two values one would be dropped silently."""

from __future__ import annotations

from collections import Counter
from typing import Any

from typer.core import TyperCommand

from merge_sumo.errors import UserError


class OnceCommand(TyperCommand):
    """A command each of whose options is given once, but those that may be several."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; `UserError` where a value would win over an earlier one."""
        # Parsing takes what it reads away from the list.
        _, _, given = self.make_parser(ctx).parse_args(args=list(args))
        for option, times in Counter(given).items():
            single = not (getattr(option, "multiple", False) or getattr(option, "count", False))
            chooses = not getattr(option, "is_flag", False) or bool(option.secondary_opts)
            if option.param_type_name == "option" and single and chooses and times > 1:
                name = max(option.opts, key=len)
                raise UserError(f"{name} is given {times} times: give it once")
        return super().parse_args(ctx, args)
