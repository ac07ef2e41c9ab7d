"""Signal and noise variance such that what is left out is predicted as well as predictions say."""
