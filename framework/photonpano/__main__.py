"""`python -m photonpano`: the command line, where its script is not on the path."""

from photonpano.api.cli import main

main()
