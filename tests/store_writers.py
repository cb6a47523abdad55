"""What processes that write into a store at once do; in a module that they can import."""

from semviz_core.common.store import Store


def write_number(store: Store, number: int) -> bool:
    """Whether this process wrote the manifest."""
    return store.write_new("manifests/000001.json", b"%d" % number * 100_000)
