"""Changes of a finished scene: `operations`, the `holes` that they leave, how these are closed (`clear` takes away what
comes to light, `fill` continues the `flat_surfaces` around), `pictures`."""
