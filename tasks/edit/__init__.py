"""Changes of a finished scene: `operations`, the `holes` that they leave, how these are closed (`fill`) by the
`flat_surfaces` around them, `pictures`."""
