"""The HTTP interface, one file a resource; every route is a thin layer over the operator's desk."""
