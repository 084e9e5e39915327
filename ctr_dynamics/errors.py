"""The errors that a user can cause and mend: one line each, with what, value, limit, unit and what to do."""

from __future__ import annotations


class InputError(ValueError):
    """An argument, file or parameter that cannot be used.

    The message is one line and says what is wrong, the value, the limit with its unit, and what to do.
    Commands print it on stderr and end with exit code 2; the node does not start, or rejects the value.

    Args:
        what: what is wrong, in one sentence without a full stop at its end; line breaks become blanks.
        do: what the reader can do about it; appended after a semicolon.
        where: file, key path or parameter name, put in front.

    Example:
        >>> from ctr_dynamics import InputError, Settings
        >>> try:
        ...     Settings({"model.nodes": 5})
        ... except InputError as error:
        ...     print(error)
        parameter model.nodes: 5 is outside its range; write 8 to 1000
    """

    def __init__(self, what: str, *, do: str = "", where: str = "") -> None:
        self.what = " ".join(str(what).split())
        self.do = " ".join(do.split())
        self.where = where
        text = f"{where}: {self.what}" if where else self.what
        if self.do:
            text += f"; {self.do}"
        super().__init__(text)
