"""Building blocks of the reports: figures as SVG text, the page around them, and their data."""
