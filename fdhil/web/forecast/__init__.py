"""Forecasts programs dropped in a browser: computed in a child process, kept while the pages are served."""
