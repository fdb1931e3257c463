"""The HTML reports and the viewer: one file each, opens offline, prints on A4."""
