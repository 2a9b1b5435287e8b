"""Pictures of the validation: phantom beside simulation with the prediction drawn in, in the style of the Fig. 2."""
def draw_correlations(path, **k): pass
def draw_rayleigh(path, **k): pass
