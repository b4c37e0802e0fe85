"""Self-contained HTML pages with plots: `page.Page` and `svg.Plot` are for any tool to use."""
