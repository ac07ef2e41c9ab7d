"""skevgp against other libraries: scikit-learn's exact GP as rows grow, and sparse GPs of GPflow, GPJax, GPyTorch."""
