"""Packages of System Structure and Parameterization (SSP 1.0 and 2.0, https://ssp-standard.org) as scenarios.

`package` opens the archive, `structure` and `parameters` read its XML, `flattening` makes one system of nested ones,
and `importing` writes the scenario.
"""
