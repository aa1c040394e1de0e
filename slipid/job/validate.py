"""Open-loop prediction of runs by a fit: what `slipid validate` does, but for its pictures."""

from pathlib import Path

from slipid.data.runs import Runs
from slipid.data.sanity.columns import refuse_misordered
from slipid.identify.compare.slip_models import restored
from slipid.identify.compare.validation import validation
from slipid.identify.fit_file import load
from slipid.identify.result import Fit
from slipid.job.config import one_floor, read_config
from slipid.job.logs import read_dataset
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter


def validate(out: Path, data: Path, report: Reporter) -> tuple[Fit, Runs, Content]:
    """Predict runs of `data` with the fit in `out`, and with every simpler model that it learnt.

    Returns the fit, the runs, and the content of the validation file.
    """
    setup_jax(quiet=True)
    fit = load(out)
    config = read_config(out / "config.toml")
    sections = one_floor(config.content.validate_.logs or config.content.logs)
    report.stage("reading logs")
    dataset, skipped = read_dataset(config, sections, data, report)
    refuse_misordered(dataset.logs)
    for sentence in skipped:
        report.line(sentence)
    seen = {sha for _, sha in fit.runs}
    again = sum(log.sha256 in seen for log in dataset.logs)
    if again:
        report.line(f"{again} of {len(dataset)} runs were fitted: they say little about new ones")
    report.stage("predicting")
    try:
        models = restored(fit.space.template.geometry, dict(fit.baselines))
    except ValueError as error:
        raise DataError(f"{out / 'fit.json'}: {error}") from error
    fitted = fit.contact
    return fit, dataset, validation(fitted, models, dataset).to_json()
