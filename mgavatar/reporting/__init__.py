"""The page about a fit, its pictures and its charts."""
