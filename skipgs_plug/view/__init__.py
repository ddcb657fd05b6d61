"""Trained models to look at: in the browser (`page`), as pictures and films (`path`, `film`), in other formats."""
