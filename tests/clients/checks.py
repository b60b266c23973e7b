"""What the checks of served lakes share: a line each, and an exit code; and how tables are written into pages."""
import re
import sys


def read_table(path, script):
    """The lines of a script's table in a page."""
    with open(path, encoding="utf-8") as file:
        _, _, behind = file.read().partition(f"<!-- {script} -->\n")
    return behind.partition("<!-- end -->")[0].splitlines()


def write_table(path, script, table):
    """Replaces the table of a script in a page: what stands between its marks."""
    with open(path, encoding="utf-8") as file:
        page = file.read()
    marked = re.compile(rf"(<!-- {re.escape(script)} -->\n).*?(<!-- end -->)", re.DOTALL)
    if not marked.search(page):
        sys.exit(f"{path} has no place for the table of {script}")
    with open(path, "w", encoding="utf-8") as file:
        file.write(marked.sub(lambda m: f"{m[1]}{table}\n{m[2]}", page))


class Checks:
    """Counts what fails."""

    def __init__(self):
        self.failed = 0

    def same(self, name, expected, act):
        """What `act` returns must be this."""
        self.holds(name, act, lambda value: value == expected)

    def holds(self, name, act, is_right=bool):
        """What `act` returns must be right."""
        try:
            value = act()
            right = is_right(value)
        except Exception as error:  # whatever a driver throws is a failure of this check alone
            value, right = f"{type(error).__name__}: {error}", False
        text = str(value).replace("\n", " ")
        print(f"{'ok  ' if right else 'FAIL'} {name}: {text[:100 if right else 600]}", flush=True)
        self.failed += not right

    def done(self):
        """The exit code."""
        print(f"{self.failed} failed")
        return 1 if self.failed else 0
