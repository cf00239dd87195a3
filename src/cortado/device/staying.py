"""What has arrays on a device, and stays in its process."""

from typing import ClassVar, NoReturn

from cortado.errors import InputError


class Staying:
    """An object that can be neither pickled nor copied, and says so."""

    instead: ClassVar[str] = "but NumPy arrays of what it holds can"
    """What can be done, in words."""

    def __reduce__(self) -> NoReturn:
        name = type(self).__name__
        article = "An" if name[0] in "AEIOU" else "A"
        raise InputError(f"{article} {name} can be neither pickled nor copied, {self.instead}.")
