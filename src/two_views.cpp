// A bundle adjustment of two views, condensed to a quadratic: the fast twin of
// bdgs_ros/back_end/pair.py, which says what it is and has the derivation of every line.

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

namespace py = pybind11;

namespace {

using Array = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Vec3 = std::array<double, 3>;
using Vec7 = std::array<double, 7>;

constexpr int kBends = 5, kUnknowns = 12, kResiduals = 4, kFree = 7;
constexpr int kReadout = 6 + kBends;
constexpr double kLeastInverse = 0.05, kMostInverse = 5.0, kSettled = 1e-5;
constexpr std::array<int, kFree> kFreeOf = {0, 1, 2, 3, 4, 5, kReadout};

struct Pose {
  double R[3][3];
  Vec3 t;
};

struct Noise {
  double px, inverse_depth_sigma, dof;
};

// What is measured of one corner.
struct Corner {
  double x, y, inverse, other_x, other_y, other_inverse, row, other_row, p_static;
  const double *bend, *other_bend;
};

struct Twists {
  const double *one, *other;
};

// One corner's residuals in sigma and their derivatives.
struct Linear {
  double r[kResiduals];
  double J[kResiduals][kUnknowns];
  double by_inverse[kResiduals];
};

struct Quadratic {
  double L[kUnknowns][kUnknowns];
  double g[kUnknowns];
};

Vec3 cross(const double* a, const Vec3& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

Vec3 rotate(const Pose& T, const Vec3& p) {
  Vec3 q;
  for (int i = 0; i < 3; ++i) q[i] = T.R[i][0] * p[0] + T.R[i][1] * p[1] + T.R[i][2] * p[2];
  return q;
}

// How far a point, times inverse depth, moves per second of readout.
Vec3 moved(const Vec3& point, double inverse, const double* twist, double row) {
  Vec3 speed = cross(twist + 3, point);
  for (int i = 0; i < 3; ++i) speed[i] = row * (speed[i] + inverse * twist[i]);
  return speed;
}

double dot_bend(const double* functions, const double* bend) {
  double sum = 0;
  for (int k = 0; k < kBends; ++k) sum += functions[k] * bend[k];
  return sum;
}

Linear linearise(const Corner& c, const Pose& T, const Twists& twists, const double* bend,
                 double readout, double inverse, const Noise& noise) {
  Linear out = {};
  const Vec3 ray = {c.x, c.y, 1};
  const Vec3 during_one = moved(ray, inverse, twists.one, c.row);
  Vec3 start;
  for (int i = 0; i < 3; ++i) start[i] = ray[i] + readout * during_one[i];
  Vec3 shutter = rotate(T, start);
  for (int i = 0; i < 3; ++i) shutter[i] += inverse * T.t[i];
  const Vec3 during_other = moved(shutter, inverse, twists.other, c.other_row);
  Vec3 p;
  for (int i = 0; i < 3; ++i) p[i] = shutter[i] - readout * during_other[i];

  const Vec3 turned = rotate(T, during_one);
  const double hat[3][3] = {{0, -p[2], p[1]}, {p[2], 0, -p[0]}, {-p[1], p[0], 0}};
  double M[3][kFree] = {};
  for (int i = 0; i < 3; ++i) {
    M[i][i] = inverse;
    for (int j = 0; j < 3; ++j) M[i][3 + j] = -hat[i][j];
    M[i][6] = turned[i] - during_other[i];
  }
  const double depth = 1 / p[2], seen = inverse * depth, sigma = noise.inverse_depth_sigma;
  const double at[2] = {p[0] * depth, p[1] * depth};
  const bool measured = c.other_inverse > 0;
  const double known = measured ? 1 / sigma : 0;
  for (int k = 0; k < kFree; ++k) {
    for (int axis = 0; axis < 2; ++axis)
      out.J[axis][kFreeOf[k]] = noise.px * depth * (M[axis][k] - at[axis] * M[2][k]);
    out.J[2][kFreeOf[k]] = -known * seen * depth * M[2][k];
  }
  for (int k = 0; k < kBends; ++k) {
    out.J[2][6 + k] = -known * c.other_bend[k];
    out.J[3][6 + k] = -c.bend[k] / sigma;
  }
  out.r[0] = noise.px * (at[0] - c.other_x);
  out.r[1] = noise.px * (at[1] - c.other_y);
  out.r[2] = measured ? (seen - c.other_inverse - dot_bend(c.other_bend, bend)) / sigma : 0;
  out.r[3] = (inverse - c.inverse - dot_bend(c.bend, bend)) / sigma;
  for (int axis = 0; axis < 2; ++axis)
    out.by_inverse[axis] = noise.px * depth * (T.t[axis] - at[axis] * T.t[2]);
  out.by_inverse[2] = known * depth * (1 - seen * T.t[2]);
  out.by_inverse[3] = 1 / sigma;
  return out;
}

// Weights of a t-distribution; a position's two residuals go together.
std::array<double, kResiduals> weights(const Linear& l, double dof, double p_static) {
  const double position = l.r[0] * l.r[0] + l.r[1] * l.r[1];
  const double at = p_static * (dof + 2) / (dof + position);
  return {at, at, p_static * (dof + 1) / (dof + l.r[2] * l.r[2]), p_static};
}

// What gives a corner's inverse depth back: its change is first + back . step.
struct Back {
  double first;
  double by_step[kUnknowns];
};

// Add a corner to the normal equations, its inverse depth taken out of them.
Back eliminate(const Linear& l, const std::array<double, kResiduals>& w, Quadratic& q) {
  double own = 0, right = 0, mixed[kUnknowns] = {};
  for (int i = 0; i < kResiduals; ++i) {
    own += w[i] * l.by_inverse[i] * l.by_inverse[i];
    right += w[i] * l.by_inverse[i] * l.r[i];
    for (int a = 0; a < kUnknowns; ++a) mixed[a] += w[i] * l.by_inverse[i] * l.J[i][a];
  }
  own = std::max(own, 1e-9);
  for (int a = 0; a < kUnknowns; ++a) {
    for (int b = 0; b < kUnknowns; ++b) {
      double sum = -mixed[a] / own * mixed[b];
      for (int i = 0; i < kResiduals; ++i) sum += w[i] * l.J[i][a] * l.J[i][b];
      q.L[a][b] += sum;
    }
    double sum = -mixed[a] * (right / own);
    for (int i = 0; i < kResiduals; ++i) sum += w[i] * l.J[i][a] * l.r[i];
    q.g[a] += sum;
  }
  Back back = {-right / own, {}};
  for (int a = 0; a < kUnknowns; ++a) back.by_step[a] = -mixed[a] / own;
  return back;
}

// Solve A x = b by elimination with pivots; A and b are used up.
Vec7 solve(double A[kFree][kFree], Vec7 b) {
  for (int c = 0; c < kFree; ++c) {
    int pivot = c;
    for (int r = c + 1; r < kFree; ++r)
      if (std::abs(A[r][c]) > std::abs(A[pivot][c])) pivot = r;
    std::swap_ranges(A[c], A[c] + kFree, A[pivot]);
    std::swap(b[c], b[pivot]);
    for (int r = c + 1; r < kFree; ++r) {
      const double factor = A[r][c] / A[c][c];
      for (int k = c; k < kFree; ++k) A[r][k] -= factor * A[c][k];
      b[r] -= factor * b[c];
    }
  }
  for (int r = kFree - 1; r >= 0; --r) {
    for (int k = r + 1; k < kFree; ++k) b[r] -= A[r][k] * b[k];
    b[r] /= A[r][r];
  }
  return b;
}

// The step of motion and readout, of which an offset and its sigma are known.
Vec7 step_of(const Quadratic& q, double offset_s, double sigma_s) {
  double A[kFree][kFree];
  Vec7 pull;
  for (int i = 0; i < kFree; ++i) {
    for (int j = 0; j < kFree; ++j) A[i][j] = q.L[kFreeOf[i]][kFreeOf[j]];
    A[i][i] += 1e-6 * A[i][i] + 1e-3;
    pull[i] = q.g[kFreeOf[i]];
  }
  A[6][6] += 1 / (sigma_s * sigma_s);
  pull[6] += offset_s / (sigma_s * sigma_s);
  Vec7 step = solve(A, pull);
  for (double& value : step) value = -value;
  return step;
}

// exp(xi) @ T, as core.se3.exp has it.
Pose moved_by(const Vec7& xi, const Pose& T) {
  const double* phi = xi.data() + 3;
  const Vec3 rho = {xi[0], xi[1], xi[2]};
  const double square = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2];
  const double angle = std::sqrt(square);
  const bool small = angle < 1e-4;  // below, 1 - cos loses its digits: Taylor's series
  const double a = small ? 1 - square / 6 : std::sin(angle) / angle;
  const double b = small ? 0.5 - square / 24 : (1 - std::cos(angle)) / square;
  const double c = small ? 1.0 / 6 - square / 120 : (angle - std::sin(angle)) / (square * angle);
  auto applied = [&](const Vec3& v, double first, double second) {
    const Vec3 once = cross(phi, v), twice = cross(phi, once);
    Vec3 out;
    for (int i = 0; i < 3; ++i) out[i] = v[i] + first * once[i] + second * twice[i];
    return out;
  };
  Pose out;
  for (int j = 0; j < 3; ++j) {
    const Vec3 column = applied({T.R[0][j], T.R[1][j], T.R[2][j]}, a, b);
    for (int i = 0; i < 3; ++i) out.R[i][j] = column[i];
  }
  out.t = applied(T.t, a, b);
  const Vec3 along = applied(rho, b, c);
  for (int i = 0; i < 3; ++i) out.t[i] += along[i];
  return out;
}

Corner corner_at(ptrdiff_t n, const double* tangents, const double* inverse,
                 const double* tangents_other, const double* inverse_other, const double* rows,
                 const double* p_static, const double* bends, const double* bends_other) {
  return {tangents[2 * n],       tangents[2 * n + 1],     inverse[n],
          tangents_other[2 * n], tangents_other[2 * n + 1], inverse_other[n],
          rows[2 * n],           rows[2 * n + 1],         p_static[n],
          bends + kBends * n,    bends_other + kBends * n};
}

struct Condensed {
  Pose T;
  double readout_s;
  Quadratic q;
  int inliers;
};

Condensed condense_corners(const std::vector<Corner>& corners, Pose T, const Twists& twists,
                           const double* bend, double readout_s, double readout_sigma_s,
                           const Noise& noise, int rounds) {
  std::vector<double> inverse;
  for (const Corner& c : corners) inverse.push_back(c.inverse + dot_bend(c.bend, bend));
  std::vector<Back> back(corners.size());
  double at_s = readout_s;
  for (int round = 0;; ++round) {
    Quadratic q = {};
    int inliers = 0;
    for (size_t n = 0; n < corners.size(); ++n) {
      const Linear l = linearise(corners[n], T, twists, bend, at_s, inverse[n], noise);
      back[n] = eliminate(l, weights(l, noise.dof, corners[n].p_static), q);
      inliers += std::abs(l.r[0]) < 3 && std::abs(l.r[1]) < 3 && std::abs(l.r[2]) < 3;
    }
    const Vec7 step = step_of(q, at_s - readout_s, readout_sigma_s);
    double largest = 0;
    for (double value : step) largest = std::max(largest, std::abs(value));
    if (round == rounds - 1 || largest < kSettled) return {T, at_s, q, inliers};
    for (size_t n = 0; n < corners.size(); ++n) {
      double change = back[n].first;
      for (int k = 0; k < kFree; ++k) change += back[n].by_step[kFreeOf[k]] * step[k];
      inverse[n] = std::clamp(inverse[n] + change, kLeastInverse, kMostInverse);
    }
    T = moved_by(step, T);
    at_s += step[6];
  }
}

void check_size(const Array& array, ptrdiff_t expected, const char* name) {
  if (array.size() != expected)
    throw py::value_error(std::string(name) + ": expected " + std::to_string(expected) +
                          " numbers, received " + std::to_string(array.size()));
}

std::tuple<Array, double, Array, Array, int> condense(
    Array tangents, Array inverse, Array tangents_other, Array inverse_other, Array rows,
    Array p_static, Array bends, Array bends_other, Array T_other_one, Array twist_one,
    Array twist_other, Array bend, double readout_s, double readout_sigma_s, double px,
    double inverse_depth_sigma, double dof, int rounds) {
  const ptrdiff_t count = inverse.size();
  check_size(tangents, 2 * count, "tangents");
  check_size(tangents_other, 2 * count, "tangents_other");
  check_size(inverse_other, count, "inverse_depth_other");
  check_size(rows, 2 * count, "rows");
  check_size(p_static, count, "p_static");
  check_size(bends, kBends * count, "bend functions");
  check_size(bends_other, kBends * count, "bend functions of the other view");
  check_size(T_other_one, 16, "T_other_one");
  check_size(twist_one, 6, "twist of the one view");
  check_size(twist_other, 6, "twist of the other view");
  check_size(bend, kBends, "bend");
  Pose T;
  const double* m = T_other_one.data();
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) T.R[i][j] = m[4 * i + j];
    T.t[i] = m[4 * i + 3];
  }
  std::vector<Corner> corners;
  for (ptrdiff_t n = 0; n < count; ++n)
    corners.push_back(corner_at(n, tangents.data(), inverse.data(), tangents_other.data(),
                                inverse_other.data(), rows.data(), p_static.data(), bends.data(),
                                bends_other.data()));
  const Twists twists = {twist_one.data(), twist_other.data()};
  const double* bend_data = bend.data();
  Condensed found;
  {
    py::gil_scoped_release release;
    found = condense_corners(corners, T, twists, bend_data, readout_s, readout_sigma_s,
                             {px, inverse_depth_sigma, dof}, rounds);
  }
  Array pose({4, 4}), information({kUnknowns, kUnknowns}), gradient(kUnknowns);
  double* out = pose.mutable_data();
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) out[4 * i + j] = found.T.R[i][j];
    out[4 * i + 3] = found.T.t[i];
    out[12 + i] = 0;
  }
  out[15] = 1;
  std::copy_n(&found.q.L[0][0], kUnknowns * kUnknowns, information.mutable_data());
  std::copy_n(found.q.g, kUnknowns, gradient.mutable_data());
  return {pose, found.readout_s, information, gradient, found.inliers};
}

}  // namespace

PYBIND11_MODULE(_two_views, m) {
  m.doc() = "Two views condensed to a quadratic; use bdgs_ros.back_end.pair";
  m.def("condense", &condense);
}
