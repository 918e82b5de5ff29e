"""Every table of README.md and docs/results.md quotes a file of results/, which a command wrote.

The last link in the line before a table names the file. The table's lines stand in that file, unchanged and in its order; rows may be left out.
"""

import re
import unittest
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\]\(([^)]*results/\w+\.md)\)")
RULE = re.compile(r"\|[ |-]+\|")


def quotations(page):
    """(line before the table, table) of every table; a table is a list of lines."""
    lines = page.splitlines()
    introduction, table = "", []
    for line in [*lines, ""]:
        if line.startswith("|"):
            table.append(line)
            continue
        if table:
            yield introduction, table
            table = []
        introduction = line or introduction


def faults(page, read):
    """Why tables of `page` are no quotations; `read(link)` is the text that the page links."""
    for introduction, table in quotations(page):
        links = LINK.findall(introduction)
        if not links:
            yield f"no results file is linked before: {table[0]}"
            continue
        source = iter(read(links[-1]).splitlines())
        yield from (f"not in {links[-1]}, or not in this order: {line}" for line in table if line not in source)


class Tables(unittest.TestCase):
    def test_are_quoted_from_results_files(self):
        for page in (SOURCE / "README.md", SOURCE / "docs/results.md"):
            text = page.read_text()
            self.assertGreater(len(list(quotations(text))), 0, page)
            self.assertEqual(list(faults(text, lambda link, page=page: (page.parent / link).read_text())), [], page)

    def test_of_results_files_are_tables_with_a_command(self):
        files = sorted((SOURCE / "tests/experiments/results").iterdir())
        self.assertGreater(len(files), 20)
        for file in files:
            text = file.read_text()
            self.assertRegex(text, r"^(## .*\n)?`(\./run experiments? |bodyschema )", file)
            self.assertTrue(any(RULE.fullmatch(line) for line in text.splitlines()), file)


class AFault(unittest.TestCase):
    RESULT = "`./run experiment x`\n\n| a | b |\n| --- | --- |\n| 1 | 2.5 |\n| 2 | 3.5 |\n"

    def found(self, *table, introduction="[x](results/x.md):"):
        page = "\n".join([introduction, "", "| a | b |", "| --- | --- |", *table])
        return list(faults(page, {"results/x.md": self.RESULT}.__getitem__))

    def test_is_no_row_that_is_left_out(self):
        self.assertEqual(self.found("| 2 | 3.5 |"), [])

    def test_is_a_figure_that_no_command_wrote(self):
        self.assertEqual(len(self.found("| 1 | 2.4 |")), 1)

    def test_is_another_order(self):
        self.assertEqual(len(self.found("| 2 | 3.5 |", "| 1 | 2.5 |")), 1)

    def test_is_a_table_without_a_link(self):
        self.assertEqual(len(self.found("| 1 | 2.5 |", introduction="as measured:")), 1)


if __name__ == "__main__":
    unittest.main()
