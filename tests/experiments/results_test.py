"""Every table of README.md and docs/results.md quotes a file of results/, which a command wrote.

The last link in the line before a table names the file. The table's lines stand in that file, unchanged and in its order; rows may be left out.

    results_test.py            tests that
    results_test.py --quote    quotes again: replaces each row by the one of the file that begins with the most equal cells
"""

import re
import sys
import unittest
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[2]
PAGES = (SOURCE / "README.md", SOURCE / "docs/results.md")
LINK = re.compile(r"\]\(([^)]*results/\w+\.md)\)")
RULE = re.compile(r"\|[ |-]+\|")


def blocks(text):
    """(introduction, lines) of each table of a page, (introduction, line) of all other lines; introduction: the last line with text."""
    introduction, table = "", []
    for line in [*text.splitlines(), None]:
        if line is not None and line.startswith("|"):
            table.append(line)
            continue
        if table:
            yield introduction, table
            table = []
        if line is not None:
            yield introduction, line
            introduction = line or introduction


def quotations(page):
    """(name of the results file or None, table) of every table; a table is a list of lines."""
    for introduction, table in blocks(page):
        if isinstance(table, list):
            yield (LINK.findall(introduction) or [None])[-1], table


def faults(page, read):
    """Why tables of `page` are no quotations; `read(link)` is the text that the page links."""
    for link, table in quotations(page):
        if link is None:
            yield f"no results file is linked before: {table[0]}"
            continue
        source = iter(read(link).splitlines())
        yield from (f"not in {link}, or not in this order: {line}" for line in table if line not in source)


def quoted_again(page, read):
    """`page` with the rows that its results files have now."""

    def equal_cells(row, other):
        pairs = list(zip(row.split("|"), other.split("|")))
        return next((i for i, (a, b) in enumerate(pairs) if a != b), len(pairs))

    lines = []
    for introduction, block in blocks(page):
        if isinstance(block, str):
            lines.append(block)
            continue
        tables = [table for _, table in quotations(read(LINK.findall(introduction)[-1]))]
        source = max(tables, key=lambda table, head=block[0]: equal_cells(head, table[0]))  # it may have columns more
        lines += source[:2] + [max(source[2:], key=lambda other, row=row: equal_cells(row, other)) for row in block[2:]]
    return "\n".join(lines) + "\n"


def beside(page):
    """Reads what a page links."""
    return lambda link: (page.parent / link).read_text()


class Tables(unittest.TestCase):
    def test_are_quoted_from_results_files(self):
        for page in PAGES:
            text = page.read_text()
            self.assertGreater(len(list(quotations(text))), 0, page)
            self.assertEqual(list(faults(text, beside(page))), [], page)

    def test_of_results_files_are_tables_with_a_command(self):
        files = sorted((SOURCE / "tests/experiments/results").iterdir())
        self.assertGreater(len(files), 20)
        for file in files:
            text = file.read_text()
            self.assertRegex(text, r"^(## .*\n)?`(\./run experiments? |bodyschema |tests/mutation/run)", file)
            self.assertTrue(any(RULE.fullmatch(line) for line in text.splitlines()), file)


class AFault(unittest.TestCase):
    RESULT = "`./run experiment x`\n\n| a | b |\n| --- | --- |\n| 1 | 2.5 |\n| 2 | 3.5 |\n"

    def page(self, *table, introduction="[x](results/x.md):"):
        return "\n".join([introduction, "", "| a | b |", "| --- | --- |", *table, "", "End.", ""])

    def read(self, link):
        return {"results/x.md": self.RESULT}[link]

    def found(self, page):
        return list(faults(page, self.read))

    def test_is_no_row_that_is_left_out(self):
        self.assertEqual(self.found(self.page("| 2 | 3.5 |")), [])

    def test_is_a_figure_that_no_command_wrote(self):
        self.assertEqual(len(self.found(self.page("| 1 | 2.4 |"))), 1)

    def test_is_another_order(self):
        self.assertEqual(len(self.found(self.page("| 2 | 3.5 |", "| 1 | 2.5 |"))), 1)

    def test_is_a_table_without_a_link(self):
        self.assertEqual(len(self.found(self.page("| 1 | 2.5 |", introduction="as measured:"))), 1)

    def test_is_mended_by_quoting_again(self):
        self.assertEqual(quoted_again(self.page("| 2 | 3.4 |"), self.read), self.page("| 2 | 3.5 |"))


if __name__ == "__main__":
    if sys.argv[1:] == ["--quote"]:
        for page in PAGES:
            page.write_text(quoted_again(page.read_text(), beside(page)))
    else:
        unittest.main()
