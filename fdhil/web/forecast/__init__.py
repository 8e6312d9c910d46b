"""Forecasts of programs dropped in a browser: computed in a process of their own, kept while the pages are served."""
