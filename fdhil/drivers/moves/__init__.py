"""Sources of move events: which moves were ordered as rapids (G0). ``fdhil.tables`` lists them."""
