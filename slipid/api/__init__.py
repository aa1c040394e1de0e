"""What a notebook imports as `slipid`: a fit and a posterior with their pictures and next steps."""
