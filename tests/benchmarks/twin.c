/* Twin of slipid.model.contact.settle: chord and Newton steps of the contact balance for one robot
   after the other, the same arithmetic in the same order of steps. Doubles in, doubles out; see bench_control.py. */
#include <math.h>
#define W 3
static const double V0 = 0.002, VR = 0.001, S1 = 0.2, W0 = 0.05, KNEE = 0.65;
typedef struct {
  double hold[W][3], roll[W][3], shift[W][2], rest[W], plain[3][W], base;
  double held[W], creep[W], drag[W], roller_creep[W], resistance[W], viscosity[W], roller_viscosity[W];
  double knee[W], scrub, lead;
} Floor;

/* sat(x) / x, and in *rise the derivative of sat, at x = speed / scale */
static double saturation(double speed, double scale, double knee, double *rise) {
  double square = (speed / scale) * (speed / scale), width = 2 * knee * knee;
  double root = sqrt((1 - square) * (1 - square) + 2 * width * square), total = 1 + square + root;
  double chord = sqrt(2 / total);
  *rise = chord / (total * root) * (root + (1 - square) + width * square);
  return chord;
}

static double slope(double speed, double scale, double knee) {
  double rise;
  return saturation(speed, scale, knee, &rise) / scale;
}

static void solve3(double m[3][3], const double b[3], double out[3]) {
  double p = m[0][0], q = m[0][1], r = m[0][2], s = m[1][0], t = m[1][1], u = m[1][2];
  double v = m[2][0], w = m[2][1], x = m[2][2];
  double c0 = t * x - u * w, c1 = u * v - s * x, c2 = s * w - t * v;
  double det = p * c0 + q * c1 + r * c2;
  double k = 1 / (fabs(det) < 1e-30 ? 1e-30 : det);
  out[0] = (c0 * b[0] + (r * w - q * x) * b[1] + (q * u - r * t) * b[2]) * k;
  out[1] = (c1 * b[0] + (p * x - r * v) * b[1] + (r * s - p * u) * b[2]) * k;
  out[2] = (c2 * b[0] + (q * v - p * w) * b[1] + (p * t - q * s) * b[2]) * k;
}

static void chord(double xi[3], const double *rim, const Floor *f) {
  double m[3][3] = {{0}}, drive[3] = {0};
  double inv = 1 / sqrt(xi[0] * xi[0] + xi[1] * xi[1] + 1e-8);
  for (int i = 0; i < W; i++) {
    const double *h = f->hold[i], *k = f->roll[i];
    double along = h[0] * xi[0] + h[1] * xi[1] + h[2] * xi[2];
    double roll = k[0] * xi[0] + k[1] * xi[1] + k[2] * xi[2];
    double active = sqrt(rim[i] * rim[i] + roll * roll + 1e-12);
    double load = f->rest[i] - f->lead * (f->shift[i][0] * xi[0] + f->shift[i][1] * xi[1]) * inv;
    load = (load < 1e-3 ? 1e-3 : load) * f->held[i];
    double pulls = load * (slope(rim[i] - along, V0 + f->creep[i] * active, f->knee[i]) + f->viscosity[i]);
    double holds = load * (f->drag[i] * slope(roll, VR + f->roller_creep[i] * active, f->knee[i]) + f->roller_viscosity[i]);
    double both = pulls + load * f->resistance[i] * slope(along, V0 + S1 * active, KNEE);
    for (int a = 0; a < 3; a++) {
      for (int b = 0; b < 3; b++) m[a][b] += h[a] * h[b] * both + k[a] * k[b] * holds;
      drive[a] += h[a] * pulls * rim[i];
    }
  }
  m[2][2] += f->scrub * slope(xi[2], W0, KNEE);
  solve3(m, drive, xi);
}

static double balance(const double xi[3], const double *rim, const Floor *f, double force[3], double m[3][3], double felt[W]) {
  double v2 = xi[0] * xi[0] + xi[1] * xi[1] + 1e-8, inv = 1 / sqrt(v2);
  for (int a = 0; a < 3; a++) {
    force[a] = 0;
    for (int b = 0; b < 3; b++) m[a][b] = 0;
  }
  for (int i = 0; i < W; i++) {
    const double *h = f->hold[i], *k = f->roll[i];
    double along = h[0] * xi[0] + h[1] * xi[1] + h[2] * xi[2];
    double roll = k[0] * xi[0] + k[1] * xi[1] + k[2] * xi[2];
    double active = sqrt(rim[i] * rim[i] + roll * roll + 1e-12), slide = rim[i] - along;
    double st = V0 + f->creep[i] * active, sr = VR + f->roller_creep[i] * active, s1 = V0 + S1 * active;
    double ahead = f->shift[i][0] * xi[0] + f->shift[i][1] * xi[1];
    double load = (f->rest[i] - f->lead * ahead * inv) * f->held[i];
    double t1, g1, u1;
    double t = slide / st * saturation(slide, st, f->knee[i], &t1);
    double g = roll / sr * saturation(roll, sr, f->knee[i], &g1);
    double u = along / s1 * saturation(along, s1, KNEE, &u1);
    double grip = t + f->viscosity[i] * slide, traction = grip - f->resistance[i] * u;
    double drag = -(f->drag[i] * g + f->roller_viscosity[i] * roll);
    double d = roll / active, brake = f->resistance[i] * u1 / s1;
    double by = load * (-t1 / st - f->viscosity[i] - brake);
    double across = load * (brake * along * S1 / s1 - t1 * slide * f->creep[i] / (st * st)) * d;
    double rolls = -load * (f->drag[i] * g1 * (1 / sr - roll * f->roller_creep[i] * d / (sr * sr)) + f->roller_viscosity[i]);
    for (int a = 0; a < 3; a++) force[a] += load * (h[a] * traction + k[a] * drag);
    for (int b = 0; b < 3; b++) {
      double pull = by * h[b] + across * k[b], push = rolls * k[b];
      if (b < 2) {
        double dl = -f->lead * f->held[i] * inv * (f->shift[i][b] - ahead / v2 * xi[b]);
        pull += traction * dl;
        push += drag * dl;
      }
      for (int a = 0; a < 3; a++) m[a][b] += h[a] * pull + k[a] * push;
    }
    felt[i] = load * grip;
  }
  double rise, turn = xi[2] / W0 * saturation(xi[2], W0, KNEE, &rise);
  force[2] -= f->scrub * turn;
  m[2][2] -= f->scrub * rise / W0;
  double yaw = force[2] / f->base;
  return force[0] * force[0] + force[1] * force[1] + yaw * yaw;
}

static void settle(double xi[3], const double *rim, const Floor *f, int chords, int newtons, double felt[W]) {
  double near[3], force[3], m[3][3], change[3], first[W], before = 0;
  for (int n = 0; n < chords; n++) chord(xi, rim, f);
  for (int a = 0; a < 3; a++) near[a] = xi[a];
  for (int n = 0; n < newtons; n++) {
    double left = balance(xi, rim, f, force, m, felt);
    if (n == 0) {
      before = left;
      for (int i = 0; i < W; i++) first[i] = felt[i];
    }
    solve3(m, force, change);
    for (int a = 0; a < 3; a++) xi[a] -= change[a];
  }
  if (!(balance(xi, rim, f, force, m, felt) <= before)) {
    for (int a = 0; a < 3; a++) xi[a] = near[a];
    for (int i = 0; i < W; i++) felt[i] = first[i];
  }
  if (!isfinite(xi[0] + xi[1] + xi[2]))
    for (int a = 0; a < 3; a++) xi[a] = f->plain[a][0] * rim[0] + f->plain[a][1] * rim[1] + f->plain[a][2] * rim[2];
}

/* rims (step, robot, wheel); floors one per robot; pose and twist (robot, 3) are carried along. */
void rollout(int steps, int robots, int chords, int newtons, double dt, const double *rims, const Floor *floors, double *pose, double *twist, double *pulled) {
  for (int n = 0; n < steps; n++)
    for (int r = 0; r < robots; r++) {
      double felt[W], *xi = twist + 3 * r, *p = pose + 3 * r;
      settle(xi, rims + 3 * ((long)n * robots + r), floors + r, chords, newtons, felt);
      double w = xi[2] * dt, small = fabs(w) < 1e-6;
      double a = small ? 1 - w * w / 6 : sin(w) / w, b = small ? 0.5 * w : (1 - cos(w)) / w;
      double x = (a * xi[0] - b * xi[1]) * dt, y = (b * xi[0] + a * xi[1]) * dt;
      double c = cos(p[2]), s = sin(p[2]);
      p[0] += c * x - s * y;
      p[1] += s * x + c * y;
      p[2] += w;
      for (int i = 0; i < W; i++) pulled[r] += felt[i] * felt[i];
    }
}
