/* The step of `slip_odometry` as one writes it by hand: estimator and controller of a robot whose
   numbers are in numbers.h, which the benchmark writes. With LEAN the parts of the estimate that
   this estimator never changes are filled in once, and not looked at by the controller. */
#include <math.h>
#include <string.h>

#include "numbers.h"
#include "slipid.h"

#define W SLIPID_WHEELS

void reference_step(slipid_state *state, const slipid_reading *reading, const double reference[6],
                    double dt, slipid_estimate *estimate, double command[W]);

static inline bool sound(double x) {
  return x - x == 0.0;
}

static inline double clip(double x, double low, double high) {
  return x < low ? low : x > high ? high : x;
}

static inline double larger(double a, double b) {
  return a > b ? a : b;
}

static inline double smaller(double a, double b) {
  return a < b ? a : b;
}

/* Speed of a wheel; the angle up to which motion is counted and the age of its reading change. */
static double wheel_speed(slipid_estimator *e, int i, double angle, double speed, double dt) {
  const double most = 4.0 * HIGHEST_SPEED, turned = (angle - e->wheels_angle[i]) / larger(dt, 1e-3);
  const bool by_angle = fabs(turned) < most && dt > 0.0; /* false where it is no number */
  const bool by_speed = fabs(speed) < most;
  const bool known = fabs(angle) < 1e7, begun = sound(e->wheels_angle[i]);
  const double read = by_angle ? turned : by_speed ? speed : e->wheels_speed[i];
  const bool good = by_angle || by_speed || (known && !begun);
  const double age = e->wheels_age[i] + larger(dt, UNTIMED);
  e->wheels_age[i] = good && dt > 0.0 ? 0.0 : smaller(age, 1e3);
  const double now = e->wheels_age[i] > STALE ? 0.0 : read;
  const bool heard = known && (dt > 0.0 || !begun);
  e->wheels_angle[i] = heard ? angle : e->wheels_angle[i] + now * dt;
  e->wheels_speed[i] = now;
  return now;
}

/* Pose after a constant twist (exact SE(2)). */
static void moved(double pose[3], const double twist[3], double dt) {
  const double w = twist[2] * dt;
  const bool small = fabs(w) < 1e-6;
  const double a = small ? 1.0 - w * w / 6.0 : sin(w) / w;
  const double b = small ? 0.5 * w : (1.0 - cos(w)) / w;
  const double x = (a * twist[0] - b * twist[1]) * dt, y = (b * twist[0] + a * twist[1]) * dt;
  const double c = cos(pose[2]), s = sin(pose[2]);
  pose[0] += c * x - s * y;
  pose[1] += s * x + c * y;
  pose[2] += w;
}

static void unknown_floors(slipid_estimate *out) {
  memset(out->surface_probability, 0, sizeof out->surface_probability);
  memset(out->covariance, 0, sizeof out->covariance);
  memset(out->believed_probability, 0, sizeof out->believed_probability);
  memset(out->believed_twist, 0, sizeof out->believed_twist);
  for (int i = 0; i < W; ++i) {
    out->surface_probability[(i + 1) * (SLIPID_FLOORS + 1) - 1] = 1.0;
  }
  out->believed_probability[sizeof out->believed_probability / sizeof(double) - 1] = 1.0;
}

static void observe(slipid_estimator *e, const slipid_reading *z, double dt, slipid_estimate *out) {
  dt = sound(dt) && dt > 0.0 ? clip(dt, 1e-4, LONGEST) : 0.0;
  const double a = 1.0 - exp(-dt / 0.6);
  double rim[W], fastest = 0.0;
  bool stale = false;
  for (int i = 0; i < W; ++i) {
    const double w = wheel_speed(e, i, z->wheel_angle[i], z->wheel_speed[i], dt);
    const double amps = fabs(z->current[i]);
    if (amps < 10.0 * HIGHEST_CURRENT) {
      e->current[i] += a * (amps - e->current[i]);
    }
    const double line = CURVE[i][0] + CURVE[i][1] * e->current[i];
    const double slip = e->current[i] > CURRENT_FROM ? clip(line, 0.0, 0.95) : 0.0;
    rim[i] = RADIUS * w * (1.0 - slip);
    stale |= e->wheels_age[i] > STALE;
    fastest = larger(fastest, fabs(w));
    out->slip[i] = slip;
    out->wheel_speed[i] = w;
    out->current[i] = e->current[i];
  }
  for (int k = 0; k < 3; ++k) {
    double sum = 0.0;
    for (int i = 0; i < W; ++i) {
      sum += INVERSE[k][i] * rim[i];
    }
    out->twist[k] = sum;
  }
  moved(e->pose, out->twist, dt);
  memcpy(out->pose, e->pose, sizeof out->pose);
#ifndef LEAN
  unknown_floors(out);
#endif
  out->stale = stale;
  out->immobilised = false;
  out->out_of_range = fastest > 1.3 * HIGHEST_SPEED;
}

static bool all_sound(const double *x, size_t count) {
  bool out = true;
  for (size_t k = 0; k < count; ++k) {
    out &= sound(x[k]);
  }
  return out;
}

#define SOUND(row) all_sound(row, sizeof(row) / sizeof(double))

static bool trusted(const slipid_estimate *e, const double reference[6]) {
  bool out = !e->stale && all_sound(reference, 6) && SOUND(e->pose) && SOUND(e->twist) &&
             SOUND(e->slip) && SOUND(e->wheel_speed) && SOUND(e->current);
#ifndef LEAN
  out = out && SOUND(e->surface_probability) && SOUND(e->covariance) &&
        SOUND(e->believed_probability) && SOUND(e->believed_twist);
#endif
  return out;
}

static inline bool turns(double tried) {
  return tried > 0.0 && fmod(tried, TURN + GO) < TURN;
}

/* For how long the body has not gone where it should, and has tried to free itself. */
static void held(slipid_controller *c, const slipid_estimate *e, double dt) {
  const double *v = c->wanted, *is = e->twist;
  const double asked = sqrt(v[0] * v[0] + v[1] * v[1] + 1e-12);
  const double goes = sqrt(is[0] * is[0] + is[1] * is[1] + 1e-12);
  const bool slow = e->immobilised || (asked > 0.1 && goes < 0.2 * asked);
  const double since = turns(c->tried) ? 0.0 : slow ? dt : -dt;
  c->still = clip(c->still + since, 0.0, 2.0 * STUCK);
  const bool tries = c->still > STUCK;
  if (tries && c->tried == 0.0) {
    c->still = 2.0 * STUCK;
  }
  c->tried = tries ? c->tried + dt : 0.0;
}

/* Twist that the pose loop asks for. */
static void pose_loop(const slipid_controller *held, const double ref[6], const double pose[3],
                      const double gap[2], double out[3]) {
  const double vx = ref[3] + PLACE * gap[0] + held->integral[0];
  const double vy = ref[4] + PLACE * gap[1] + held->integral[1];
  const double c = cos(pose[2]), s = sin(pose[2]), tried = held->tried;
  out[0] = c * vx + s * vy;
  out[1] = c * vy - s * vx;
  out[2] = ref[5] + YAW * sin(ref[2] - pose[2]);
  if (tried > 0.0) {
    const double more = 1.0 + RECOVERY_GROWTH * tried;
    const bool turning = turns(tried);
    out[0] *= turning ? 0.0 : more;
    out[1] *= turning ? 0.0 : more;
    out[2] *= turning ? more : 0.0;
  }
  const double fast = larger(sqrt(out[0] * out[0] + out[1] * out[1] + 1e-12) / TWIST_LIMIT, 1.0);
  out[0] /= fast;
  out[1] /= fast;
}

/* Wheel speeds within all limits, scaled together. */
static void limited(const double wanted[W], const double before[W], const double amps[W], double dt,
                    double out[W]) {
  double over = 1.0, step[W], size = 0.0;
  bool all = true;
  for (int i = 0; i < W; ++i) {
    all &= sound(wanted[i]);
  }
  for (int i = 0; i < W; ++i) {
    const double drop = RESISTANCE * fabs(sound(amps[i]) ? amps[i] : 0.0);
    const double left = larger(VOLTAGE_LIMIT - drop, 0.2 * VOLTAGE_LIMIT);
    const double most = smaller(SPEED_LIMIT, left / VOLTS_PER_SPEED);
    over = larger(over, all ? fabs(wanted[i]) / most : 0.0);
  }
  for (int i = 0; i < W; ++i) {
    step[i] = (all ? wanted[i] : 0.0) / over - before[i];
    size = larger(size, fabs(step[i]));
  }
  const double allowed = ACCELERATION_LIMIT * smaller(dt, 0.5);
  const double part = size > allowed ? allowed / larger(size, 1e-9) : 1.0;
  for (int i = 0; i < W; ++i) {
    out[i] = clip(before[i] + step[i] * part, -SPEED_LIMIT, SPEED_LIMIT);
  }
}

/* Speed that wheels start from: the last command, else what they are seen to do. */
static void starts(const slipid_controller *c, const slipid_estimate *e, bool safe, double out[W]) {
  for (int i = 0; i < W; ++i) {
    const double from = c->begun ? c->command[i] : safe ? e->wheel_speed[i] : 0.0;
    out[i] = sound(from) ? from : 0.0;
  }
}

static void control(slipid_controller *c, const double reference[6], const slipid_estimate *e,
                    double dt, double command[W]) {
  bool safe = trusted(e, reference);
  double pose[3], ref[6], wanted[3], wheels[W], before[W], off = 0.0;
  for (int k = 0; k < 3; ++k) {
    pose[k] = safe ? e->pose[k] : 0.0;
  }
  for (int k = 0; k < 6; ++k) {
    ref[k] = safe ? reference[k] : 0.0;
  }
  dt = sound(dt) && dt > 0.0 ? smaller(dt, 0.5) : 0.0;
  const double gap[2] = {ref[0] - pose[0], ref[1] - pose[1]};
  safe = safe && !(c->tried > GIVES_UP);
  pose_loop(c, ref, pose, gap, wanted);
  held(c, e, safe ? dt : 0.0);
  const double a = 1.0 - exp(-dt / OBSERVE);
  for (int k = 0; k < 3; ++k) {
    const double is = safe ? e->twist[k] : 0.0;
    const double miss = c->miss[k] + a * (is - c->wanted[k] - c->miss[k]);
    wanted[k] -= OBSERVER * miss;
    c->miss[k] = safe ? clip(miss, -0.2, 0.2) : 0.0;
    c->wanted[k] = safe ? wanted[k] : 0.0;
  }
  for (int i = 0; i < W; ++i) {
    const double *j = FORWARD[i];
    wheels[i] = safe ? (j[0] * wanted[0] + j[1] * wanted[1] + j[2] * wanted[2]) / RADIUS : 0.0;
  }
  starts(c, e, safe, before);
  limited(wheels, before, e->current, safe ? dt : larger(dt, UNTIMED), command);
  for (int i = 0; i < W; ++i) {
    off = larger(off, fabs(command[i] - wheels[i]));
    c->command[i] = command[i];
  }
  for (int k = 0; k < 2; ++k) {
    const double summed = clip(c->integral[k] + INTEGRAL * gap[k] * dt, -LONGEST_I, LONGEST_I);
    c->integral[k] = safe ? (off < 0.05 ? summed : c->integral[k]) : 0.0;
  }
  c->begun = true;
}

void reference_step(slipid_state *state, const slipid_reading *reading, const double reference[6],
                    double dt, slipid_estimate *estimate, double command[W]) {
  observe(&state->estimator, reading, dt, estimate);
  control(&state->controller, reference, estimate, dt, command);
}
