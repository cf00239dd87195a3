"""Pictures to show: shaded fluid on a floor, in its container of glass. `cortado.render` has those with derivatives."""
