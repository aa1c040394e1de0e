"""Andrakhanov and Belyaev's GMDH networks: slip from wheels and currents."""
