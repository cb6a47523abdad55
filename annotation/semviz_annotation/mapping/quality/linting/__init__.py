"""The rules of ``mapping.lint``, each a small function over one ``Case``."""
