#include <math.h>

#define GOLDEN_STEPS @STEPS@
#define GOLDEN_GIVEN @INPUTS@
#define GOLDEN_SAID @OUTPUTS@

static const double golden_given[GOLDEN_STEPS][GOLDEN_GIVEN] = {
@GIVEN@
};

static const double golden_said[GOLDEN_STEPS][GOLDEN_SAID] = {
@SAID@
};

static const double golden_command[GOLDEN_STEPS][SLIPID_DRIVES] = {
@COMMAND@
};

static const double golden_scale[GOLDEN_SAID] = {
@SCALE@
};

static const char *const golden_names[GOLDEN_SAID] = {
@NAMES@
};

static void golden_reading(slipid_reading *reading, const double *row) {
@FILL@
}

static void golden_said_of(const slipid_estimate *estimate, double *out) {
@READ@
}

