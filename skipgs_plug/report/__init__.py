"""One HTML page from finished runs: read a folder (`source`), draw (`plots`), write (`page`)."""
