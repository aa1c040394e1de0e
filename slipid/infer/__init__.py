"""What the data know: fit results, verdicts, profiles, posteriors, designs, motors on a bench."""
