"""Changes of the text of a file, and of the words on a command line."""

from collections.abc import Callable

from fuzz import oddities
from fuzz.oddities import Random
from fuzz.toml_text import to_toml_value


def mutate_text(text: bytes, random: Random) -> tuple[bytes, str]:
    """The bytes of a file, changed in one way, and what was done."""
    change = TEXT_MUTATIONS[random.integers(len(TEXT_MUTATIONS))]
    return change(text, random), change.__name__.strip("_").replace("_", " ")


def _a_line_twice(text: bytes, random: Random) -> bytes:
    lines = text.splitlines(keepends=True)
    at = random.integers(len(lines))
    return b"".join([*lines[: at + 1], *lines[at:]])


def _a_line_less(text: bytes, random: Random) -> bytes:
    lines = text.splitlines(keepends=True)
    del lines[random.integers(len(lines))]
    return b"".join(lines)


def _characters_changed(text: bytes, random: Random) -> bytes:
    changed = bytearray(text)
    for at in random.integers(len(text), size=random.integers(1, 6)):
        changed[at] = random.integers(256)
    return bytes(changed)


def _a_character_less(text: bytes, random: Random) -> bytes:
    at = random.integers(len(text))
    return text[:at] + text[at + 1 :]


def _cut(text: bytes, random: Random) -> bytes:
    return text[: random.integers(len(text))]


def _bytes_inserted(text: bytes, random: Random) -> bytes:
    pieces = [b"\x00", b"\xff", b"\xed\xa0\x80", b"\xef\xbb\xbf", b'"""', b"\x1b[2J", b"[", b"= =", b"\r"]
    at = random.integers(len(text))
    return text[:at] + pieces[random.integers(len(pieces))] + text[at:]


def _other_encoding(text: bytes, random: Random) -> bytes:
    encoding = str(random.choice(["utf-16", "utf-8-sig", "utf-32", "cp500"]))
    return text.decode().encode(encoding)


def _other_line_ends(text: bytes, random: Random) -> bytes:
    return text.replace(b"\n", [b"\r\n", b"\r"][random.integers(2)])


def _deep(text: bytes, random: Random) -> bytes:
    depth = int(random.choice([20, 500, 20_000]))
    return text + b"x = " + b"[" * depth + b"]" * depth + b"\n"


def _long_key(text: bytes, random: Random) -> bytes:
    return text + b".".join([b"a"] * int(random.choice([100, 5000, 100_000]))) + b" = 1\n"


def _many_tables(text: bytes, random: Random) -> bytes:
    return text + b"".join(b"\n[t%d]\nx = 1\n" % k for k in range(int(random.choice([100, 20_000, 200_000]))))


def _long_number(text: bytes, random: Random) -> bytes:
    return text + b"x = " + b"9" * int(random.choice([1000, 4301, 100_000])) + b"\n"


TEXT_MUTATIONS: tuple[Callable[[bytes, Random], bytes], ...] = (
    _a_line_twice,
    _a_line_less,
    _characters_changed,
    _characters_changed,
    _a_character_less,
    _cut,
    _bytes_inserted,
    _bytes_inserted,
    _other_encoding,
    _other_line_ends,
    _deep,
    _long_key,
    _many_tables,
    _long_number,
)

KEYS = (
    "solver.time_step", "fluid[0].upper", "fluid.0.lower", "discretisation.spacing", "forces.gravity", "name", "phase",
    "container", "fluid[7].upper", "fluid[-1].upper", "solver", "render.resolution", "", ".", "a..b",
    "solver.time_step.x", "phase[0].colour[1]", "optimise.iterations", "problem.steps", "wäter",
    "fluid[99999999999999999999]",
    "\x1b[31m",
    "x.y.z",
)  # fmt: skip


def override(random: Random) -> str:
    """The value of ``--set``."""
    key = KEYS[random.integers(len(KEYS))]
    value = oddities.value(random)
    text = value if isinstance(value, str) else to_toml_value(value)
    whole = str(random.choice(["{key}={text}", "{key}={text}", "{key} = {text}", "{key}", "={text}", "{key}=={text}"]))
    return whole.format(key=key, text=text[:50_000]).replace("\x00", "")


def option(random: Random) -> list[str]:
    """An option of a command with a value that is odd, or one that it has not."""
    options = ("--steps", "--record-every", "--precision", "--device", "--set", "--step", "-x", "--resume")
    name = options[random.integers(len(options))]
    value = oddities.NUMBERS[random.integers(len(oddities.NUMBERS))] if random.random() < 0.5 else oddities.text(random)
    word = to_toml_value(value) if not isinstance(value, str) else value
    return [name, word[:50_000].replace("\x00", "")] if random.random() < 0.9 else [name]
