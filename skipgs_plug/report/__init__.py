"""Make one HTML page from finished runs: read the folders (`source`), draw (`plots`), write the page (`page`)."""
