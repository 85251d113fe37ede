"""The HTTP interface, one module for each resource; the routes pass requests on to the operator's desk."""
