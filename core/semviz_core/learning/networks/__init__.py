"""Networks, exact under padding: what fills a batch up changes no answer."""
