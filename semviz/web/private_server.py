"""viser's server, without its way out of this machine. Importing this imports viser (1 s)."""

import viser


class PrivateServer(viser.ViserServer):
    """A scene that no client can put on the network: viser lets each open a public tunnel."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None
