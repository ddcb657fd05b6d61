"""A model in any browser, a phone's too: PlayCanvas's SuperSplat viewer (MIT), and photographs beside it."""
