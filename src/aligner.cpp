// Direct RGB-D alignment on one core: pyramids, normal equations, Gauss-Newton, residual maps.
//
// The readable twin of everything here is bdgs_ros/tracking/align_numpy.py, function by function;
// the method is explained there. This file adds only what speed needs: points in structures of
// arrays, blocks of them in stack buffers, and every hot loop compiled for three instruction sets.

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

namespace py = pybind11;

// Comparisons of floats never trap here; saying so lets the compiler vectorise selections.
#pragma GCC optimize("no-trapping-math", "no-signed-zeros", "no-math-errno")

#define BDGS_INLINE static inline __attribute__((always_inline))

#if defined(__x86_64__) && defined(__GNUC__)
static int detect_isa() {
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw"))
    return 2;
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? 1 : 0;
}
static const int kIsa = detect_isa();
// Compile NAME_body for three instruction sets and choose at run time.
#define BDGS_VERSIONS(NAME, PARAMETERS, ARGUMENTS)                                             \
  static void NAME##_base PARAMETERS { NAME##_body ARGUMENTS; }                                \
  __attribute__((target("avx2,fma"))) static void NAME##_avx2 PARAMETERS {                     \
    NAME##_body ARGUMENTS;                                                                     \
  }                                                                                            \
  __attribute__((target("avx512f,avx512dq,avx512vl,avx512bw,avx2,fma,prefer-vector-width=512"))) \
  static void NAME##_avx512 PARAMETERS {                                                       \
    NAME##_body ARGUMENTS;                                                                     \
  }                                                                                            \
  static void NAME PARAMETERS {                                                                \
    if (kIsa == 2)                                                                             \
      NAME##_avx512 ARGUMENTS;                                                                 \
    else if (kIsa == 1)                                                                        \
      NAME##_avx2 ARGUMENTS;                                                                   \
    else                                                                                       \
      NAME##_base ARGUMENTS;                                                                   \
  }
#else
#define BDGS_VERSIONS(NAME, PARAMETERS, ARGUMENTS) \
  static void NAME PARAMETERS { NAME##_body ARGUMENTS; }
#endif

namespace {

using Plane = std::vector<float>;

BDGS_INLINE float min_f(float a, float b) { return a < b ? a : b; }
BDGS_INLINE float max_f(float a, float b) { return a > b ? a : b; }
BDGS_INLINE float abs_f(float a) { return a < 0 ? -a : a; }

struct Params {
  int max_iterations = 20;
  double stop_px = 0.05;
  double dof = 5.0;
  double intensity_noise = 0.01;
  double pixel_noise = 0.2;
  double depth_noise = 0.0025;
  double depth_weight = 0.5;
  double pattern_information = 1.25e5;
  double inlier_intensity = 0.08;
  double inlier_depth_sigma = 6.0;
  double min_static = 0.25;
  double shade = 0.03;
  int max_points = 20000;
};

// What is worth comparing in a reference level, in rows of the image.
struct Points {
  Plane x, y, z, grey, gx, gy, dx, dy, p_static;
  int size() const { return static_cast<int>(x.size()); }
};

// What a level knows of its image; pyramids of one frame with other masks share it.
struct Images {
  Plane grey, gx, gy;    // [0, 1] and per pixel
  Plane inverse_depth;   // 1 / m, 0 = invalid
  Plane smooth, dx, dy;  // inverse depth where its 3x3 window is one surface, and its gradient
};

struct Level {
  int width = 0, height = 0;
  float fx = 0, fy = 0, cx = 0, cy = 0;
  std::shared_ptr<Images> images;
  Plane p_static;
  Points points;
  std::unique_ptr<std::once_flag> points_once = std::make_unique<std::once_flag>();

  Level(int w, int h) : width(w), height(h), images(std::make_shared<Images>()) {
    const size_t n = static_cast<size_t>(w) * h;
    Images& i = *images;
    for (Plane* plane : {&i.grey, &i.gx, &i.gy, &i.inverse_depth, &i.smooth, &i.dx, &i.dy})
      plane->assign(n, 0.0f);
    p_static.assign(n, 1.0f);
  }
  // The same image with nothing masked yet.
  explicit Level(const std::shared_ptr<Images>& shared, const Level& like)
      : width(like.width), height(like.height), fx(like.fx), fy(like.fy), cx(like.cx),
        cy(like.cy), images(shared), p_static(like.p_static.size(), 1.0f) {}
};

// Motion of the camera while its image was read out, first row to last: (rho, phi), in its frame.
using Sweep = std::array<float, 6>;

struct Pyramid {
  std::vector<Level> levels;  // finest first
  int block = 1;              // input pixels per pixel of the finest level and axis
  Sweep sweep{};
  Pyramid() = default;
  Pyramid(const Pyramid&) = delete;
};

// ---------------------------------------------------------------------------- pyramid

BDGS_INLINE float discontinuity(float inverse_depth, float depth_noise) {
  return 0.03f * inverse_depth + 4.0f * depth_noise;
}

BDGS_INLINE void grey_row_body(const uint8_t* __restrict image, int channels, int n,
                               float* __restrict sum) {
  if (channels == 1) {
    for (int i = 0; i < n; ++i) sum[i] += image[i];
  } else {
    for (int i = 0; i < n; ++i)
      sum[i] += 0.299f * image[3 * i] + 0.587f * image[3 * i + 1] + 0.114f * image[3 * i + 2];
  }
}
BDGS_VERSIONS(grey_row, (const uint8_t* __restrict image, int channels, int n,
                         float* __restrict sum),
              (image, channels, n, sum))

// Mean over k x k blocks of the input image, as a plane in [0, 1].
void average_image(const uint8_t* image, int width, int channels, int k, Level& level) {
  Plane sum(width);
  const float scale = 1.0f / (255.0f * k * k);
  for (int v = 0; v < level.height; ++v) {
    std::fill(sum.begin(), sum.end(), 0.0f);
    for (int j = 0; j < k; ++j)
      grey_row(image + static_cast<size_t>(v * k + j) * width * channels, channels, width,
               sum.data());
    float* out = &level.images->grey[static_cast<size_t>(v) * level.width];
    if (k == 1) {
      for (int u = 0; u < level.width; ++u) out[u] = scale * sum[u];
    } else if (k == 2) {
      for (int u = 0; u < level.width; ++u) out[u] = scale * (sum[2 * u] + sum[2 * u + 1]);
    } else {
      for (int u = 0; u < level.width; ++u) {
        float total = 0;
        for (int i = 0; i < k; ++i) total += sum[u * k + i];
        out[u] = scale * total;
      }
    }
  }
}

void average_static(const uint8_t* p_dynamic, int width, int k, Level& level) {
  const float scale = 1.0f / (255.0f * k * k);
  std::vector<int> sum(level.width);
  for (int v = 0; v < level.height; ++v) {
    std::fill(sum.begin(), sum.end(), 0);
    for (int j = 0; j < k; ++j) {
      const uint8_t* row = p_dynamic + static_cast<size_t>(v * k + j) * width;
      for (int i = 0; i < k; ++i)
        for (int u = 0; u < level.width; ++u) sum[u] += row[u * k + i];
    }
    float* out = &level.p_static[static_cast<size_t>(v) * level.width];
    for (int u = 0; u < level.width; ++u) out[u] = 1.0f - scale * sum[u];
  }
}

BDGS_INLINE void invert_body(const float* __restrict depth_m, int n, float* __restrict out) {
  for (int i = 0; i < n; ++i) {
    const float z = depth_m[i];
    const bool good = z > 0.05f && z < 100.0f;  // false for NaN too
    out[i] = good ? 1.0f / (good ? z : 1.0f) : 0.0f;
  }
}
BDGS_VERSIONS(invert, (const float* __restrict depth_m, int n, float* __restrict out),
              (depth_m, n, out))

// Mean of the four values that lie on the nearest surface; 0 if all are invalid.
BDGS_INLINE float nearest_mean(float a, float b, float c, float d, float depth_noise) {
  const float top = max_f(max_f(a, b), max_f(c, d));
  const float low = max_f(top - discontinuity(top, depth_noise), 1e-6f);
  const float wa = a >= low ? 1.0f : 0.0f, wb = b >= low ? 1.0f : 0.0f;
  const float wc = c >= low ? 1.0f : 0.0f, wd = d >= low ? 1.0f : 0.0f;
  const float count = wa + wb + wc + wd;
  return (wa * a + wb * b + wc * c + wd * d) / (count > 0 ? count : 1.0f);
}

BDGS_INLINE void halve_depth_row_body(const float* __restrict top, const float* __restrict bottom,
                                      int n, float depth_noise, float* __restrict out) {
#pragma omp simd
  for (int u = 0; u < n; ++u)
    out[u] = nearest_mean(top[2 * u], top[2 * u + 1], bottom[2 * u], bottom[2 * u + 1],
                          depth_noise);
}
BDGS_VERSIONS(halve_depth_row,
              (const float* __restrict top, const float* __restrict bottom, int n,
               float depth_noise, float* __restrict out),
              (top, bottom, n, depth_noise, out))

Plane halve_depth(const Plane& fine, int width, int height, float depth_noise) {
  const int w = width / 2, h = height / 2;
  Plane coarse(static_cast<size_t>(w) * h);
  for (int v = 0; v < h; ++v) {
    const float* row = &fine[static_cast<size_t>(2 * v) * width];
    halve_depth_row(row, row + width, w, depth_noise, &coarse[static_cast<size_t>(v) * w]);
  }
  return coarse;
}

BDGS_INLINE void halve_row_body(const float* __restrict top, const float* __restrict bottom,
                                int n, float* __restrict out) {
#pragma omp simd
  for (int u = 0; u < n; ++u)
    out[u] = 0.25f * (top[2 * u] + top[2 * u + 1] + bottom[2 * u] + bottom[2 * u + 1]);
}
BDGS_VERSIONS(halve_row,
              (const float* __restrict top, const float* __restrict bottom, int n,
               float* __restrict out),
              (top, bottom, n, out))

void halve_plane(const Plane& fine, int width, Plane& coarse, int w, int h) {
  for (int v = 0; v < h; ++v) {
    const float* row = &fine[static_cast<size_t>(2 * v) * width];
    halve_row(row, row + width, w, &coarse[static_cast<size_t>(v) * w]);
  }
}

// Central differences of one inner row of the grey plane.
BDGS_INLINE void grey_gradient_row_body(const float* __restrict c, int width, int n,
                                        float* __restrict gx, float* __restrict gy) {
  const float* __restrict up = c - width;
  const float* __restrict down = c + width;
#pragma omp simd
  for (int u = 0; u < n; ++u) {
    gx[u] = 0.5f * (c[u + 1] - c[u - 1]);
    gy[u] = 0.5f * (down[u] - up[u]);
  }
}
BDGS_VERSIONS(grey_gradient_row,
              (const float* __restrict c, int width, int n, float* __restrict gx,
               float* __restrict gy),
              (c, width, n, gx, gy))

// Sobel gradient of inverse depth, and where its window is one surface.
BDGS_INLINE void depth_gradient_row_body(const float* __restrict c, int width, int n,
                                         float depth_noise, float* __restrict smooth,
                                         float* __restrict dx, float* __restrict dy) {
  const float* __restrict a = c - width;
  const float* __restrict b = c + width;
#pragma omp simd
  for (int u = 0; u < n; ++u) {
    const float low = min_f(min_f(min_f(min_f(a[u - 1], a[u]), min_f(a[u + 1], c[u - 1])),
                                  min_f(min_f(c[u], c[u + 1]), min_f(b[u - 1], b[u]))),
                            b[u + 1]);
    const float top = max_f(max_f(max_f(max_f(a[u - 1], a[u]), max_f(a[u + 1], c[u - 1])),
                                  max_f(max_f(c[u], c[u + 1]), max_f(b[u - 1], b[u]))),
                            b[u + 1]);
    const float one = (low > 0 && top - low < 2 * discontinuity(c[u], depth_noise)) ? 1.0f : 0.0f;
    smooth[u] = one * c[u];
    dx[u] = one * 0.125f * (a[u + 1] - a[u - 1] + 2 * (c[u + 1] - c[u - 1]) + b[u + 1] - b[u - 1]);
    dy[u] = one * 0.125f * (b[u - 1] - a[u - 1] + 2 * (b[u] - a[u]) + b[u + 1] - a[u + 1]);
  }
}
BDGS_VERSIONS(depth_gradient_row,
              (const float* __restrict c, int width, int n, float depth_noise,
               float* __restrict smooth, float* __restrict dx, float* __restrict dy),
              (c, width, n, depth_noise, smooth, dx, dy))

void add_gradients(Level& level, float depth_noise) {
  Images& images = *level.images;
  for (int v = 1; v + 1 < level.height; ++v) {
    const size_t i = static_cast<size_t>(v) * level.width + 1;
    grey_gradient_row(&images.grey[i], level.width, level.width - 2, &images.gx[i], &images.gy[i]);
    depth_gradient_row(&images.inverse_depth[i], level.width, level.width - 2, depth_noise,
                       &images.smooth[i], &images.dx[i], &images.dy[i]);
  }
}

void fill_static(Pyramid& pyramid, const uint8_t* p_dynamic, int width) {
  if (p_dynamic == nullptr) return;
  average_static(p_dynamic, width, pyramid.block, pyramid.levels[0]);
  for (size_t l = 1; l < pyramid.levels.size(); ++l) {
    const Level& fine = pyramid.levels[l - 1];
    Level& coarse = pyramid.levels[l];
    halve_plane(fine.p_static, fine.width, coarse.p_static, coarse.width, coarse.height);
  }
}

template <typename T>
const T* data_of(const py::object& object, int height, int width, const char* name,
                 py::array_t<T, py::array::c_style>& keep, int* channels = nullptr) {
  keep = py::array_t<T, py::array::c_style>::ensure(object);
  const bool color = channels != nullptr && keep && keep.ndim() == 3 && keep.shape(2) == 3;
  if (!keep || (keep.ndim() != 2 && !color) || keep.shape(0) != height || keep.shape(1) != width)
    throw py::value_error(std::string(name) + ": does not have the camera's height and width");
  if (channels != nullptr) *channels = color ? 3 : 1;
  return keep.data();
}

Pyramid* build_pyramid(const py::object& image, const py::object& depth_m,
                       const py::object& p_dynamic, int width, int height, double fx, double fy,
                       double cx, double cy, int block, int n_levels, double depth_noise,
                       const Sweep& sweep) {
  py::array_t<uint8_t, py::array::c_style> keep_image, keep_dynamic;
  py::array_t<float, py::array::c_style> keep_depth;
  int channels = 1;
  const uint8_t* pixels = data_of<uint8_t>(image, height, width, "image", keep_image, &channels);
  const float* depth = data_of<float>(depth_m, height, width, "depth_m", keep_depth);
  const uint8_t* dynamic =
      p_dynamic.is_none() ? nullptr
                          : data_of<uint8_t>(p_dynamic, height, width, "p_dynamic", keep_dynamic);
  py::gil_scoped_release release;
  const float noise = static_cast<float>(depth_noise);
  auto pyramid = std::make_unique<Pyramid>();
  pyramid->block = block;
  pyramid->sweep = sweep;
  pyramid->levels.reserve(n_levels);
  pyramid->levels.emplace_back(width / block, height / block);
  average_image(pixels, width, channels, block, pyramid->levels[0]);
  Plane inverse_depth(static_cast<size_t>(width) * height);
  invert(depth, width * height, inverse_depth.data());
  for (int k = block, w = width, h = height; k > 1; k /= 2, w /= 2, h /= 2)
    inverse_depth = halve_depth(inverse_depth, w, h, noise);
  pyramid->levels[0].images->inverse_depth = std::move(inverse_depth);
  double scale = 1.0 / block;
  for (int l = 0; l < n_levels; ++l, scale *= 0.5) {
    if (l > 0) {
      const Level& fine = pyramid->levels[l - 1];
      const Images& images = *fine.images;
      pyramid->levels.emplace_back(fine.width / 2, fine.height / 2);
      Level& coarse = pyramid->levels.back();
      halve_plane(images.grey, fine.width, coarse.images->grey, coarse.width, coarse.height);
      coarse.images->inverse_depth =
          halve_depth(images.inverse_depth, fine.width, fine.height, noise);
    }
    Level& level = pyramid->levels[l];
    level.fx = static_cast<float>(fx * scale);
    level.fy = static_cast<float>(fy * scale);
    level.cx = static_cast<float>((cx + 0.5) * scale - 0.5);
    level.cy = static_cast<float>((cy + 0.5) * scale - 0.5);
    add_gradients(level, noise);
  }
  fill_static(*pyramid, dynamic, width);
  return pyramid.release();
}

Pyramid* with_dynamic(const Pyramid& pyramid, const py::object& p_dynamic, int width, int height,
                      const Sweep& sweep) {
  py::array_t<uint8_t, py::array::c_style> keep;
  const uint8_t* dynamic = data_of<uint8_t>(p_dynamic, height, width, "p_dynamic", keep);
  if (width / pyramid.block != pyramid.levels[0].width ||
      height / pyramid.block != pyramid.levels[0].height)
    throw py::value_error("p_dynamic: does not have the size of the image of this pyramid");
  py::gil_scoped_release release;
  auto masked = std::make_unique<Pyramid>();
  masked->block = pyramid.block;
  masked->sweep = sweep;
  masked->levels.reserve(pyramid.levels.size());
  for (const Level& level : pyramid.levels) masked->levels.emplace_back(level.images, level);
  fill_static(*masked, dynamic, width);
  return masked.release();
}

// Row of a level as a share of the readout, 0 in the middle of the image.
BDGS_INLINE float row_share(float v, float rows) {
  return min_f(max_f((v + 0.5f) / rows, 0.0f), 1.0f) - 0.5f;
}

constexpr float kLeastStatic = 0.02f;  // what surely moves is not worth its time

// Points where the camera sees them in the middle of its readout. Every pixel is written, and the
// next one over it where it is none: a branch per pixel would cost more.
void collect_points(Level& level, const Sweep& s) {
  const Images& images = *level.images;
  Points& points = level.points;
  const std::array<Plane*, 9> planes = {&points.x,  &points.y,  &points.z,
                                        &points.grey, &points.gx, &points.gy,
                                        &points.dx, &points.dy, &points.p_static};
  for (Plane* plane : planes) plane->resize(static_cast<size_t>(level.width) * level.height);
  float *x = points.x.data(), *y = points.y.data(), *z = points.z.data();
  float *grey = points.grey.data(), *gx = points.gx.data(), *gy = points.gy.data();
  float *dx = points.dx.data(), *dy = points.dy.data(), *p_static = points.p_static.data();
  size_t count = 0;
  for (int v = 1; v + 1 < level.height; ++v) {
    const float r = row_share(static_cast<float>(v), static_cast<float>(level.height));
    for (int u = 1; u + 1 < level.width; ++u) {
      const size_t i = static_cast<size_t>(v) * level.width + u;
      const float inverse = images.inverse_depth[i];
      const float c = 1.0f / inverse;
      const float a = (u - level.cx) / level.fx * c, b = (v - level.cy) / level.fy * c;
      x[count] = a + r * (s[0] + s[4] * c - s[5] * b);
      y[count] = b + r * (s[1] + s[5] * a - s[3] * c);
      z[count] = c + r * (s[2] + s[3] * b - s[4] * a);
      grey[count] = images.grey[i];
      gx[count] = images.gx[i];
      gy[count] = images.gy[i];
      dx[count] = images.dx[i];
      dy[count] = images.dy[i];
      p_static[count] = level.p_static[i];
      count += inverse > 0 && level.p_static[i] >= kLeastStatic;
    }
  }
  for (Plane* plane : planes) plane->resize(count);
}

const Points& points_of(Pyramid& pyramid, int index) {
  Level& level = pyramid.levels.at(index);
  std::call_once(*level.points_once, [&] { collect_points(level, pyramid.sweep); });
  return level.points;
}

// ---------------------------------------------------------------------------- normal equations

constexpr int kBlock = 256;
constexpr int kPattern = 3;                  // xx, yy, xy: error of inverse depth over the image
constexpr int kBias = 7, kColor = 8, kDepth = 6 + kPattern;
constexpr int kUnknowns = kColor + kPattern;  // rho, phi, gain, bias, pattern

using Appearance = std::array<double, 2 + kPattern>;  // gain, bias, pattern

struct Scales {
  float intensity = 0.1f;      // of residuals in grey levels
  float inverse_depth = 0.1f;  // and in 1 / m
};

// Which gradients the Jacobians are made of: shares of the current image's and the reference's, and
// whether depth has the part that needs none.
struct Mixture {
  float grey, grey_reference, depth, depth_reference, along_z;
};
constexpr Mixture kFit{0.5f, 0.5f, 1.0f, 0.0f, 1.0f};    // efficient second order
constexpr Mixture kMean{0.5f, 0.5f, 0.5f, 0.5f, 1.0f};   // what both images show and what they
constexpr Mixture kHalf{0.5f, -0.5f, 0.5f, -0.5f, 0.0f};  // do not agree on

struct State {
  float R[9], t[3], gain, bias, pattern[kPattern];
  Scales scales;
  Sweep sweep;  // of the current image
  Mixture mixture = kFit;
  float least_static = 0;  // what is masked weighs so much at least
};

struct Totals {
  double H[kUnknowns][kUnknowns] = {};
  double g[kUnknowns] = {};
  double cost = 0, weight = 0;
  double texture = 0;  // squared gradients of grey, as the motion sees them
  int in_view = 0, reference = 0, compared = 0, inliers = 0;
};

struct alignas(64) Block {
  // columns of the Jacobians, and the residual as one more
  float JI[kColor + 1][kBlock], JD[kDepth + 1][kBlock];
  float weight[kBlock], cost[kBlock];
  float abs_I[kBlock], abs_D[kBlock];  // |residual| of comparable pixels, -1 elsewhere
  float in_view[kBlock], reference[kBlock], compared[kBlock], inlier[kBlock];
  float seen[kBlock], depth[kBlock];
  int at[kBlock];  // pixel of the current image
};

BDGS_INLINE float mix(float a, float b, float c, float d, float fu, float fv) {
  const float top = a + fu * (b - a), bottom = c + fu * (d - c);
  return top + fv * (bottom - top);
}

BDGS_INLINE void fill_block_body(const Points* points, int begin, int n, const Level* level,
                                 const State* state, const Params* params, Block* block) {
  const float* __restrict px = points->x.data() + begin;
  const float* __restrict py_ = points->y.data() + begin;
  const float* __restrict pz = points->z.data() + begin;
  const float* __restrict pgrey = points->grey.data() + begin;
  const float* __restrict pgx = points->gx.data() + begin;
  const float* __restrict pgy = points->gy.data() + begin;
  const float* __restrict pdx = points->dx.data() + begin;
  const float* __restrict pdy = points->dy.data() + begin;
  const float* __restrict pstatic = points->p_static.data() + begin;
  const Images* images = level->images.get();
  const float* __restrict grey = images->grey.data();
  const float* __restrict gx = images->gx.data();
  const float* __restrict gy = images->gy.data();
  const float* __restrict smooth = images->smooth.data();
  const float* __restrict dx = images->dx.data();
  const float* __restrict dy = images->dy.data();
  const float* __restrict raw = images->inverse_depth.data();
  const float* __restrict cstatic = level->p_static.data();
  Block& out = *block;
  const State s = *state;
  const Mixture mix_g = s.mixture;
  const int width = level->width;
  const float fx = level->fx, fy = level->fy, cx = level->cx, cy = level->cy;
  const float max_u = level->width - 2.0f, max_v = level->height - 2.0f;
  const float rows = static_cast<float>(level->height);
  const float var_I = s.scales.intensity * s.scales.intensity;
  const float var_D = s.scales.inverse_depth * s.scales.inverse_depth;
  const float var_px = static_cast<float>(params->pixel_noise * params->pixel_noise);
  const float dof = static_cast<float>(params->dof);
  const float min_static = static_cast<float>(params->min_static);
  const float sqrt_depth_weight = static_cast<float>(std::sqrt(params->depth_weight));
  const float inlier_I = static_cast<float>(params->inlier_intensity);
  const float inlier_D = static_cast<float>(params->inlier_depth_sigma * params->depth_noise);
#pragma omp simd
  for (int i = 0; i < n; ++i) {
    // where the reference point lies in the current image
    const float X = px[i], Y = py_[i], Z = pz[i];
    const float xm = s.R[0] * X + s.R[1] * Y + s.R[2] * Z + s.t[0];
    const float ym = s.R[3] * X + s.R[4] * Y + s.R[5] * Z + s.t[1];
    const float zm = s.R[6] * X + s.R[7] * Y + s.R[8] * Z + s.t[2];
    // ... and where when its row was read out
    const float r = row_share(fy * ym / (zm > 0.05f ? zm : 1.0f) + cy, rows);
    const float x = xm - r * (s.sweep[0] + s.sweep[4] * zm - s.sweep[5] * ym);
    const float y = ym - r * (s.sweep[1] + s.sweep[5] * xm - s.sweep[3] * zm);
    const float z_raw = zm - r * (s.sweep[2] + s.sweep[3] * ym - s.sweep[4] * xm);
    const float z = z_raw > 0.05f ? z_raw : 1.0f;
    const float iz = 1.0f / z;
    const float tx = x * iz, ty = y * iz;
    const float u_raw = fx * tx + cx, v_raw = fy * ty + cy;
    const float seen = (z_raw > 0.05f && u_raw >= 1.0f && v_raw >= 1.0f && u_raw < max_u &&
                        v_raw < max_v) ? 1.0f : 0.0f;
    const float u = seen > 0 ? u_raw : 1.0f, v = seen > 0 ? v_raw : 1.0f;
    const int iu = static_cast<int>(u), iv = static_cast<int>(v);
    const float fu = u - iu, fv = v - iv;
    const int at = iv * width + iu;
    const int near = static_cast<int>(v + 0.5f) * width + static_cast<int>(u + 0.5f);

    // residuals
    const float eI = mix(grey[at], grey[at + 1], grey[at + width], grey[at + width + 1], fu, fv) -
                     (s.gain * pgrey[i] + s.bias);
    const float ra = smooth[at], rb = smooth[at + 1];
    const float rc = smooth[at + width], rd = smooth[at + width + 1];
    const float has_depth = (ra > 0 && rb > 0 && rc > 0 && rd > 0) ? seen : 0.0f;
    const float iZ = 1.0f / Z, sx = X * iZ, sy = Y * iZ, stretch = iz * iz * Z * Z;
    const float qxx = tx * tx - stretch * sx * sx;
    const float qyy = ty * ty - stretch * sy * sy;
    const float qxy = tx * ty - stretch * sx * sy;
    const float warp = s.pattern[0] * qxx + s.pattern[1] * qyy + s.pattern[2] * qxy;
    const float eD = has_depth * (mix(ra, rb, rc, rd, fu, fv) - iz + warp);

    // gradients: grey as the mean of both images (efficient second order), inverse depth smooth
    const float gu = 0.5f * (gx[near] + pgx[i]), gv = 0.5f * (gy[near] + pgy[i]);
    const float du = dx[near], dv = dy[near];
    const float mgu = mix_g.grey * gx[near] + mix_g.grey_reference * pgx[i];
    const float mgv = mix_g.grey * gy[near] + mix_g.grey_reference * pgy[i];
    const float mdu = mix_g.depth * du + mix_g.depth_reference * pdx[i];
    const float mdv = mix_g.depth * dv + mix_g.depth_reference * pdy[i];

    // weights: t-distribution of both residuals together, times P(static)
    const float iI = 1.0f / __builtin_sqrtf(var_I + var_px * (gu * gu + gv * gv));
    const float iD = 1.0f / __builtin_sqrtf(var_D + var_px * (du * du + dv * dv));
    const float nI = eI * iI, nD = eD * iD;
    const float m2 = nI * nI + nD * nD;
    const float gap = raw[near] - iz, limit = 0.03f * iz + 4.0f * s.scales.inverse_depth;
    const float same = (raw[near] > 0 && abs_f(gap) > limit) ? 0.0f : 1.0f;  // surface
    const float w = same * (dof + 1.0f + has_depth) / (dof + m2);
    const float ps = seen * max_f(pstatic[i] * cstatic[near], s.least_static);
    const float root = __builtin_sqrtf(ps * w);
    const float hI = root * iI, hD = root * iD * has_depth * sqrt_depth_weight;

    const float ax = mgu * fx * iz, ay = mgv * fy * iz, az = -(ax * tx + ay * ty);
    out.JI[0][i] = hI * ax;
    out.JI[1][i] = hI * ay;
    out.JI[2][i] = hI * az;
    out.JI[3][i] = hI * (y * az - z * ay);
    out.JI[4][i] = hI * (z * ax - x * az);
    out.JI[5][i] = hI * (x * ay - y * ax);
    out.JI[6][i] = -hI * pgrey[i];
    out.JI[7][i] = -hI;
    out.JI[kColor][i] = hI * eI;
    const float bx = mdu * fx * iz, by = mdv * fy * iz;
    const float bz = -(bx * tx + by * ty) + mix_g.along_z * iz * iz;
    out.JD[0][i] = hD * bx;
    out.JD[1][i] = hD * by;
    out.JD[2][i] = hD * bz;
    out.JD[3][i] = hD * (y * bz - z * by);
    out.JD[4][i] = hD * (z * bx - x * bz);
    out.JD[5][i] = hD * (x * by - y * bx);
    out.JD[6][i] = hD * qxx;
    out.JD[7][i] = hD * qyy;
    out.JD[8][i] = hD * qxy;
    out.JD[kDepth][i] = hD * eD;

    const float aI = abs_f(eI), aD = abs_f(eD);
    const float compared = ps >= min_static ? 1.0f : 0.0f;
    const float reference = pstatic[i] >= 0.5f ? 1.0f : 0.0f;
    out.weight[i] = ps * w * (1.0f + has_depth);
    out.cost[i] = ps * w * m2;
    out.abs_I[i] = compared > 0 ? aI : -1.0f;
    out.abs_D[i] = compared * has_depth > 0 ? aD : -1.0f;
    out.compared[i] = compared;
    out.inlier[i] = (aI < inlier_I && aD < inlier_D) ? compared * same : 0.0f;
    out.reference[i] = reference;
    out.in_view[i] = reference * seen;
    out.seen[i] = seen;
    out.depth[i] = z;
    out.at[i] = near;
  }
}
BDGS_VERSIONS(fill_block,
              (const Points* points, int begin, int n, const Level* level, const State* state,
               const Params* params, Block* block),
              (points, begin, n, level, state, params, block))

// Products of one column with four others: four sums at once keep the processor busy.
BDGS_INLINE void dots(const float* __restrict a, const float (*b)[kBlock], int n, double* out) {
  float s0 = 0, s1 = 0, s2 = 0, s3 = 0;
#pragma omp simd reduction(+ : s0, s1, s2, s3)
  for (int i = 0; i < n; ++i) {
    s0 += a[i] * b[0][i];
    s1 += a[i] * b[1][i];
    s2 += a[i] * b[2][i];
    s3 += a[i] * b[3][i];
  }
  out[0] = s0;
  out[1] = s1;
  out[2] = s2;
  out[3] = s3;
}

// All products of N columns, i <= j; a few below the diagonal come along.
template <int N>
BDGS_INLINE void gram(const float (*J)[kBlock], int n, double (*out)[N]) {
  for (int i = 0; i < N; ++i) {
    int j = i;
    for (; j + 4 <= N; j += 4) dots(J[i], J + j, n, &out[i][j]);
    if (j < N) dots(J[i], J + (N - 4), n, &out[i][N - 4]);
  }
}

BDGS_INLINE float total(const float* __restrict a, int n) {
  float sum = 0;
#pragma omp simd reduction(+ : sum)
  for (int i = 0; i < n; ++i) sum += a[i];
  return sum;
}

BDGS_INLINE void add_block_body(const Block* block, int n, Totals* totals) {
  double color[kColor + 1][kColor + 1], depth[kDepth + 1][kDepth + 1];
  gram<kColor + 1>(block->JI, n, color);
  gram<kDepth + 1>(block->JD, n, depth);
  for (int i = 0; i < kColor; ++i) {
    for (int j = i; j < kColor; ++j) totals->H[i][j] += color[i][j];
    totals->g[i] += color[i][kColor];
  }
  for (int i = 0; i < kDepth; ++i) {
    const int row = i < 6 ? i : i + 2;  // gain and bias lie between
    for (int j = i; j < kDepth; ++j) totals->H[row][j < 6 ? j : j + 2] += depth[i][j];
    totals->g[row] += depth[i][kDepth];
  }
  totals->texture += color[0][0] + color[1][1];
  totals->cost += total(block->cost, n);
  totals->weight += total(block->weight, n);
  totals->in_view += static_cast<int>(total(block->in_view, n) + 0.5f);
  totals->reference += static_cast<int>(total(block->reference, n) + 0.5f);
  totals->compared += static_cast<int>(total(block->compared, n) + 0.5f);
  totals->inliers += static_cast<int>(total(block->inlier, n) + 0.5f);
}
BDGS_VERSIONS(add_block, (const Block* block, int n, Totals* totals), (block, n, totals))

// Which absolute residuals the medians are taken of: about 4000, spread over the image.
struct Samples {
  std::vector<float> I, D;

  void add(const Block& block, int n) {
    for (int i = 0; i < n; ++i) {
      if (block.abs_I[i] >= 0) I.push_back(block.abs_I[i]);
      if (block.abs_D[i] >= 0) D.push_back(block.abs_D[i]);
    }
  }
  static float median(std::vector<float>& values) {
    if (values.empty()) return 0;
    auto middle = values.begin() + values.size() / 2;
    std::nth_element(values.begin(), middle, values.end());
    return *middle;
  }
};

constexpr int kSampleBlocks = 16;

// Which blocks of a level are compared, and of which of them the medians are taken.
struct Blocks {
  int all, step, sample;  // step and sample in blocks

  Blocks(const Points& points, const Params& params)
      : all((points.size() + kBlock - 1) / kBlock),
        step(std::max(1, points.size() / std::max(1, params.max_points))),
        sample(step * std::max(1, (all + step - 1) / step / kSampleBlocks)) {}
};

// The sums stand for all points, however many were compared.
void scale_to(int all, int compared, Totals& totals) {
  const double scale = compared > 0 ? static_cast<double>(all) / compared : 1.0;
  for (int i = 0; i < kUnknowns; ++i) {
    totals.g[i] *= scale;
    for (int j = i; j < kUnknowns; ++j) totals.H[j][i] = totals.H[i][j] *= scale;
  }
  totals.cost *= scale;
  totals.weight *= scale;
  totals.texture *= scale;
  for (int* count : {&totals.in_view, &totals.reference, &totals.compared, &totals.inliers})
    *count = static_cast<int>(*count * scale + 0.5);
}

Totals accumulate(const Points& points, const Level& level, const State& state,
                  const Params& params, Samples& samples) {
  Totals totals;
  Block block;
  const Blocks blocks(points, params);
  int compared = 0;
  for (int k = 0; k < blocks.all; k += blocks.step) {
    const int begin = k * kBlock, n = std::min(kBlock, points.size() - begin);
    fill_block(&points, begin, n, &level, &state, &params, &block);
    add_block(&block, n, &totals);
    if (k % blocks.sample == 0) samples.add(block, n);
    compared += n;
  }
  scale_to(points.size(), compared, totals);
  return totals;
}

void probe(const Points& points, const Level& level, const State& state, const Params& params,
           Samples& samples) {
  Block block;
  const Blocks blocks(points, params);
  for (int k = 0; k < blocks.all; k += blocks.sample) {
    const int begin = k * kBlock, n = std::min(kBlock, points.size() - begin);
    fill_block(&points, begin, n, &level, &state, &params, &block);
    samples.add(block, n);
  }
}

// ---------------------------------------------------------------------------- Gauss-Newton

using Matrix4 = std::array<double, 16>;
using Vector6 = std::array<double, 6>;

Matrix4 multiply(const Matrix4& a, const Matrix4& b) {
  Matrix4 c{};
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j)
      for (int k = 0; k < 4; ++k) c[4 * i + j] += a[4 * i + k] * b[4 * k + j];
  return c;
}

Matrix4 rigid_inverse(const Matrix4& T) {
  Matrix4 out{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      out[4 * i + j] = T[4 * j + i];
      out[4 * i + 3] -= T[4 * j + i] * T[4 * j + 3];
    }
  }
  out[15] = 1;
  return out;
}

// I + b [w] + c [w]^2
std::array<double, 9> polynomial(const double* w, double b, double c) {
  const double x = w[0], y = w[1], z = w[2];
  return {1 - c * (y * y + z * z), -b * z + c * x * y,      b * y + c * x * z,
          b * z + c * x * y,       1 - c * (x * x + z * z), -b * x + c * y * z,
          -b * y + c * x * z,      b * x + c * y * z,       1 - c * (x * x + y * y)};
}

Matrix4 se3_exp(const double* xi) {
  const double* w = xi + 3;
  const double t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], t = std::sqrt(t2);
  const bool small = t < 1e-6;
  const double a = small ? 1 - t2 / 6 : std::sin(t) / t;
  const double b = small ? 0.5 - t2 / 24 : (1 - std::cos(t)) / t2;
  const double c = small ? 1.0 / 6 - t2 / 120 : (1 - a) / t2;
  const auto R = polynomial(w, a, b), V = polynomial(w, b, c);
  Matrix4 T{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      T[4 * i + j] = R[3 * i + j];
      T[4 * i + 3] += V[3 * i + j] * xi[j];
    }
  }
  T[15] = 1;
  return T;
}

// Take rounding out of the rotation: Gram-Schmidt on its rows.
void orthonormalise(Matrix4& T) {
  double* a = &T[0];
  double* b = &T[4];
  double* c = &T[8];
  const double na = std::sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]);
  for (int i = 0; i < 3; ++i) a[i] /= na;
  const double ab = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  for (int i = 0; i < 3; ++i) b[i] -= ab * a[i];
  const double nb = std::sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2]);
  for (int i = 0; i < 3; ++i) b[i] /= nb;
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}

// Tangent of a motion of less than about 3 rad.
Vector6 se3_log(const Matrix4& T) {
  double w[3] = {0.5 * (T[9] - T[6]), 0.5 * (T[2] - T[8]), 0.5 * (T[4] - T[1])};
  const double s = std::sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
  const double angle = std::atan2(s, 0.5 * (T[0] + T[5] + T[10] - 1));
  const double scale = s < 1e-9 ? 1.0 : angle / s;
  for (double& value : w) value *= scale;
  const double t2 = angle * angle;
  const double c = angle < 1e-4 ? 1.0 / 12 : (1 - 0.5 * angle * std::sin(angle) /
                                              (1 - std::cos(angle))) / t2;
  const auto V = polynomial(w, -0.5, c);
  Vector6 xi{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) xi[i] += V[3 * i + j] * T[4 * j + 3];
    xi[3 + i] = w[i];
  }
  return xi;
}

// Solve A x = b by Cholesky; false where A is not positive definite.
bool solve(double A[kUnknowns][kUnknowns], const double* b, double* x) {
  double L[kUnknowns][kUnknowns] = {};
  for (int i = 0; i < kUnknowns; ++i) {
    for (int j = 0; j <= i; ++j) {
      double sum = A[i][j];
      for (int k = 0; k < j; ++k) sum -= L[i][k] * L[j][k];
      if (i == j) {
        if (!(sum > 0)) return false;
        L[i][i] = std::sqrt(sum);
      } else {
        L[i][j] = sum / L[j][j];
      }
    }
  }
  double y[kUnknowns];
  for (int i = 0; i < kUnknowns; ++i) {
    double sum = b[i];
    for (int k = 0; k < i; ++k) sum -= L[i][k] * y[k];
    y[i] = sum / L[i][i];
  }
  for (int i = kUnknowns - 1; i >= 0; --i) {
    double sum = y[i];
    for (int k = i + 1; k < kUnknowns; ++k) sum -= L[k][i] * x[k];
    x[i] = sum / L[i][i];
  }
  return true;
}

struct Prior {
  Matrix4 T{};
  std::array<double, 36> information{};
  bool active = false;
};

State state_of(const Matrix4& T, const Appearance& appearance, const Scales& scales,
               const Sweep& sweep) {
  State s;
  s.sweep = sweep;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) s.R[3 * i + j] = static_cast<float>(T[4 * i + j]);
    s.t[i] = static_cast<float>(T[4 * i + 3]);
  }
  s.gain = static_cast<float>(appearance[0]);
  s.bias = static_cast<float>(appearance[1]);
  for (int i = 0; i < kPattern; ++i) s.pattern[i] = static_cast<float>(appearance[2 + i]);
  s.scales = scales;
  return s;
}

constexpr int kFewer = 5000;    // points are enough on coarser levels, and to tell in the end how
constexpr int kEnough = 20000;  // well images agree, if not much less of them is to be compared
constexpr double kDoubt = 1.1;  // noise of two images agrees by chance, a little

// What both images say of the motion.
struct Agreement {
  double H[kUnknowns][kUnknowns] = {};
  double texture = 0;  // 1: gradients of grey are the same, 0: they have nothing in common
};

struct Solution {
  Matrix4 T{};
  Appearance appearance{1, 0, 0, 0, 0};
  Totals totals;
  Agreement agreement;
  float median_I = 0, median_D = 0;
  int iterations = 0;
  bool converged = false;
};

Scales scales_of(Samples& samples, const Params& params) {
  constexpr float sigma_per_median = 1.4826f;
  Scales scales;
  scales.intensity = std::max(static_cast<float>(params.intensity_noise),
                              sigma_per_median * Samples::median(samples.I));
  scales.inverse_depth = std::max(static_cast<float>(params.depth_noise),
                                  sigma_per_median * Samples::median(samples.D));
  return scales;
}

Params with_fewer(Params params) {
  params.max_points = std::min(params.max_points, kFewer);
  return params;
}

// Compare the images once more where they were found to lie. Gradients that only one of them has,
// as noise has, cancel in what both say.
void judge(const Points& points, const Level& level, State state, const Params& asked,
           Solution& out) {
  const Params params = out.totals.compared > kEnough ? with_fewer(asked) : asked;
  Samples seen, unused;
  state.mixture = kMean;
  out.totals = accumulate(points, level, state, params, seen);
  out.median_I = Samples::median(seen.I);
  out.median_D = Samples::median(seen.D);
  state.mixture = kHalf;
  const Totals half = accumulate(points, level, state, params, unused);
  const double both = out.totals.texture, one = half.texture;
  for (int i = 0; i < kUnknowns; ++i)
    for (int j = 0; j < kUnknowns; ++j)
      out.agreement.H[i][j] =
          out.totals.H[i][j] - (i < 6 && j < 6 ? kDoubt * half.H[i][j] : 0.0);
  out.agreement.texture = (both - one) / std::max(both + one, 1e-12);
}

constexpr double kOverRelaxation = 1.3;  // reweighting and gradient noise make steps too short
constexpr double kBrightnessTie = 1e-3;  // share of the pixels that say gain 1 and bias 0

// One Gauss-Newton step; returns its size in pixels, negative if there is none.
double step(const Totals& totals, const Prior& prior, const Params& params, double fx,
            Matrix4& T, Appearance& appearance) {
  double A[kUnknowns][kUnknowns], b[kUnknowns], x[kUnknowns];
  for (int i = 0; i < kUnknowns; ++i) {
    b[i] = -totals.g[i];
    for (int j = 0; j < kUnknowns; ++j) A[i][j] = totals.H[i][j];
    A[i][i] += 1e-6 * totals.H[i][i] + 1e-9;
  }
  const double tie = kBrightnessTie * totals.H[7][7];
  for (int i = 0; i < 2 + kPattern; ++i) {
    const double weight = i < 2 ? tie : params.pattern_information;
    A[6 + i][6 + i] += weight;
    b[6 + i] -= weight * (appearance[i] - (i == 0 ? 1.0 : 0.0));
  }
  if (prior.active) {
    const Vector6 error = se3_log(multiply(prior.T, rigid_inverse(T)));
    for (int i = 0; i < 6; ++i) {
      for (int j = 0; j < 6; ++j) {
        A[i][j] += prior.information[6 * i + j];
        b[i] += prior.information[6 * i + j] * error[j];
      }
    }
  }
  if (!solve(A, b, x)) return -1;
  for (double& value : x) value *= kOverRelaxation;
  T = multiply(se3_exp(x), T);
  orthonormalise(T);
  for (int i = 0; i < 2 + kPattern; ++i) appearance[i] += x[6 + i];
  const double move = std::sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
  const double turn = std::sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5]);
  return fx * (move + turn);  // of a point at 1 m
}

constexpr int kReserved = 4;            // iterations kept for every finer level
constexpr double kCoarseStop = 2.0;     // coarser levels stop at larger steps

Solution run_alignment(Pyramid& reference, Pyramid& current,
                       const std::vector<std::pair<int, int>>& pairs, const Matrix4& T_init,
                       const Prior& prior, const Params& asked) {
  Solution out;
  out.T = T_init;
  Scales scales;
  int left = asked.max_iterations;
  for (size_t k = 0; k < pairs.size(); ++k) {
    const Points& points = points_of(reference, pairs[k].first);
    const Level& target = current.levels[pairs[k].second];
    const int finer = static_cast<int>(pairs.size() - k - 1);
    const Params params = finer > 0 ? with_fewer(asked) : asked;
    const int budget = std::min(left, std::max(2, left - kReserved * finer));
    const double stop = params.stop_px * (finer > 0 ? kCoarseStop : 1.0);
    Samples samples;
    probe(points, target, state_of(out.T, out.appearance, scales, current.sweep), params, samples);
    scales = scales_of(samples, params);
    out.converged = false;
    for (int i = 0; i < budget && !out.converged; ++i, --left) {
      Samples seen;
      out.totals = accumulate(points, target,
                              state_of(out.T, out.appearance, scales, current.sweep), params, seen);
      const double size = step(out.totals, prior, params, target.fx, out.T, out.appearance);
      if (size < 0) break;
      ++out.iterations;
      scales = scales_of(seen, params);
      out.converged = size < stop;
    }
  }
  judge(points_of(reference, pairs.back().first), current.levels[pairs.back().second],
        state_of(out.T, out.appearance, scales, current.sweep), asked, out);
  return out;
}

// ---------------------------------------------------------------------------- cells

// What the points that one square of the current image shows say of the motion, on their own.
struct Cell {
  double H[6][6] = {}, g[6] = {};
  double cost = 0, weight = 0, depth = 0;
  double mixed[6] = {}, own = 0, off = 0;  // the square's brightness in H, and in g
  int seen = 0;
};

// Leave open how bright the square is: vignettes and shadows are no motion.
void leave_brightness_open(Cell& cell, double shade) {
  const double own = cell.own + 1.0 / (shade * shade);
  for (int a = 0; a < 6; ++a) {
    for (int b = a; b < 6; ++b) cell.H[a][b] -= cell.mixed[a] * cell.mixed[b] / own;
    cell.g[a] -= cell.mixed[a] * cell.off / own;
  }
  cell.cost -= cell.off * cell.off / own;
}

std::vector<Cell> accumulate_cells(const Points& points, const Level& level, const State& state,
                                   const Params& params, int size) {
  const int columns = (level.width + size - 1) / size, rows = (level.height + size - 1) / size;
  std::vector<Cell> cells(static_cast<size_t>(columns) * rows);
  Block block;
  for (int begin = 0; begin < points.size(); begin += kBlock) {
    const int n = std::min(kBlock, points.size() - begin);
    fill_block(&points, begin, n, &level, &state, &params, &block);
    for (int i = 0; i < n; ++i) {
      if (block.seen[i] <= 0) continue;
      const double shade = block.JI[kBias][i];
      const int u = block.at[i] % level.width, v = block.at[i] / level.width;
      Cell& cell = cells[static_cast<size_t>(v / size) * columns + u / size];
      for (int a = 0; a < 6; ++a) {
        const double color = block.JI[a][i], depth = block.JD[a][i];
        for (int b = a; b < 6; ++b) cell.H[a][b] += color * block.JI[b][i] + depth * block.JD[b][i];
        cell.g[a] += color * block.JI[kColor][i] + depth * block.JD[kDepth][i];
        cell.mixed[a] += color * shade;
      }
      cell.off += shade * block.JI[kColor][i];
      cell.own += shade * shade;
      cell.cost += block.cost[i];
      cell.weight += block.weight[i];
      cell.depth += block.depth[i];
      cell.seen += 1;
    }
  }
  for (Cell& cell : cells) {
    cell.depth /= std::max(cell.seen, 1);
    leave_brightness_open(cell, params.shade);
    for (int a = 0; a < 6; ++a)
      for (int b = 0; b < a; ++b) cell.H[a][b] = cell.H[b][a];
  }
  return cells;
}

// ---------------------------------------------------------------------------- residual maps

struct Maps {
  Plane depth_sigma, color;
  std::vector<uint8_t> valid;
};

// Where points of the reference lie in the current image, and their inverse depth; 0 outside.
BDGS_INLINE void project_block_body(const Points* points, int begin, int n, const Level* level,
                                    const State* state, float min_static, int* __restrict at,
                                    float* __restrict inverse_depth) {
  const float* __restrict px = points->x.data() + begin;
  const float* __restrict py_ = points->y.data() + begin;
  const float* __restrict pz = points->z.data() + begin;
  const float* __restrict p_static = points->p_static.data() + begin;
  const State s = *state;
  const int width = level->width;
  const float fx = level->fx, fy = level->fy, cx = level->cx, cy = level->cy;
  const float max_u = level->width - 0.5f, max_v = level->height - 0.5f;
  const float rows = static_cast<float>(level->height);
#pragma omp simd
  for (int i = 0; i < n; ++i) {
    const float X = px[i], Y = py_[i], Z = pz[i];
    const float xm = s.R[0] * X + s.R[1] * Y + s.R[2] * Z + s.t[0];
    const float ym = s.R[3] * X + s.R[4] * Y + s.R[5] * Z + s.t[1];
    const float zm = s.R[6] * X + s.R[7] * Y + s.R[8] * Z + s.t[2];
    const float r = row_share(fy * ym / (zm > 0.05f ? zm : 1.0f) + cy, rows);
    const float z_raw = zm - r * (s.sweep[2] + s.sweep[3] * ym - s.sweep[4] * xm);
    const float iz = 1.0f / (z_raw > 0.05f ? z_raw : 1.0f);
    const float x = xm - r * (s.sweep[0] + s.sweep[4] * zm - s.sweep[5] * ym);
    const float y = ym - r * (s.sweep[1] + s.sweep[5] * xm - s.sweep[3] * zm);
    const float u_raw = fx * x * iz + cx, v_raw = fy * y * iz + cy;
    const bool seen = p_static[i] >= min_static && zm > 0.05f && z_raw > 0.05f && u_raw > -0.5f &&
                      v_raw > -0.5f && u_raw < max_u && v_raw < max_v;
    const float u = seen ? u_raw : 0.0f, v = seen ? v_raw : 0.0f;
    at[i] = static_cast<int>(v + 0.5f) * width + static_cast<int>(u + 0.5f);
    inverse_depth[i] = seen ? iz : 0.0f;
  }
}
BDGS_VERSIONS(project_block,
              (const Points* points, int begin, int n, const Level* level, const State* state,
               float min_static, int* __restrict at, float* __restrict inverse_depth),
              (points, begin, n, level, state, min_static, at, inverse_depth))

// z-buffer of the reference seen from the current camera: nearest depth and its grey value
void splat(const Points& points, const Level& target, const State& s, float min_static,
           Plane& inverse_depth, Plane& grey) {
  alignas(64) int at[kBlock];
  alignas(64) float iz[kBlock];
  for (int begin = 0; begin < points.size(); begin += kBlock) {
    const int n = std::min(kBlock, points.size() - begin);
    project_block(&points, begin, n, &target, &s, min_static, at, iz);
    for (int i = 0; i < n; ++i) {
      if (iz[i] > inverse_depth[at[i]]) {
        inverse_depth[at[i]] = iz[i];
        grey[at[i]] = points.grey[begin + i];
      }
    }
  }
}

// The range of what a row of the z-buffer holds within one pixel to either side; the planes have
// a pixel more on each side, and where the z-buffer is empty they say so by these values.
constexpr float kNone = 1e9f;

struct Range {
  Plane top, low, dark, bright;
  explicit Range(int n) : top(n), low(n), dark(n), bright(n) {}
};

BDGS_INLINE void range_row_body(const float* __restrict near, const float* __restrict far,
                                const float* __restrict dark, const float* __restrict bright,
                                int n, Range* range) {
  float* __restrict top = range->top.data();
  float* __restrict low = range->low.data();
  float* __restrict out_dark = range->dark.data();
  float* __restrict out_bright = range->bright.data();
#pragma omp simd
  for (int u = 0; u < n; ++u) {
    top[u] = max_f(max_f(near[u], near[u + 1]), near[u + 2]);
    low[u] = min_f(min_f(far[u], far[u + 1]), far[u + 2]);
    out_dark[u] = min_f(min_f(dark[u], dark[u + 1]), dark[u + 2]);
    out_bright[u] = max_f(max_f(bright[u], bright[u + 1]), bright[u + 2]);
  }
}
BDGS_VERSIONS(range_row,
              (const float* __restrict near, const float* __restrict far,
               const float* __restrict dark, const float* __restrict bright, int n, Range* range),
              (near, far, dark, bright, n, range))

struct CompareRow {
  const float *model, *image, *shade;  // inverse depth of both, and the image's grey
  const Range *above, *here, *below;
  float *depth_sigma, *color;
  uint8_t* valid;
};

BDGS_INLINE void compare_row_body(const CompareRow* row, int n, float gain, float bias,
                                  float depth_noise) {
  const float* __restrict model = row->model;
  const float* __restrict image = row->image;
  const float* __restrict shade = row->shade;
  const Range &a = *row->above, &b = *row->here, &c = *row->below;
  const float *top_a = a.top.data(), *top_b = b.top.data(), *top_c = c.top.data();
  const float *low_a = a.low.data(), *low_b = b.low.data(), *low_c = c.low.data();
  const float *dark_a = a.dark.data(), *dark_b = b.dark.data(), *dark_c = c.dark.data();
  const float *bright_a = a.bright.data(), *bright_b = b.bright.data(), *bright_c = c.bright.data();
  float* __restrict depth_sigma = row->depth_sigma;
  float* __restrict color = row->color;
  uint8_t* __restrict valid = row->valid;
#pragma omp simd
  for (int u = 0; u < n; ++u) {
    const bool both = model[u] > 0 && image[u] > 0;
    const float top = max_f(max_f(top_a[u], top_b[u]), top_c[u]);
    const float low = min_f(min_f(low_a[u], low_b[u]), low_c[u]);
    const float dark = min_f(min_f(dark_a[u], dark_b[u]), dark_c[u]);
    const float bright = max_f(max_f(bright_a[u], bright_b[u]), bright_c[u]);
    const float z = 1.0f / (both ? image[u] : 1.0f);
    const float nearest = 1.0f / (both ? top : 1.0f), farthest = 1.0f / (both ? low : 1.0f);
    const float bound = min_f(max_f(z, nearest), farthest);  // of the model, nearest to z
    const float sigma = depth_noise * __builtin_sqrtf(z * z * z * z + bound * bound * bound * bound);
    const float shown = min_f(max_f(shade[u], gain * dark + bias), gain * bright + bias);
    depth_sigma[u] = both ? (bound - z) / sigma : 0.0f;
    color[u] = both ? shown - shade[u] : 0.0f;
    valid[u] = both ? 1 : 0;
  }
}
BDGS_VERSIONS(compare_row,
              (const CompareRow* row, int n, float gain, float bias, float depth_noise),
              (row, n, gain, bias, depth_noise))

Maps compare(const Level& target, const Plane& inverse_depth, const Plane& grey, const State& s,
             float depth_noise) {
  const int w = target.width, h = target.height;
  const Images& image = *target.images;
  Maps maps{Plane(inverse_depth.size()), Plane(inverse_depth.size()),
            std::vector<uint8_t>(inverse_depth.size())};
  const int padded = w + 2;
  Plane near(padded, 0.0f), far(padded, kNone), dark(padded, kNone), bright(padded, -kNone);
  std::array<Range, 3> ranges{Range(w), Range(w), Range(w)};
  auto find_range = [&](int v) {  // of one row, empty outside the image
    for (int u = 0; u < w; ++u) {
      const size_t at = static_cast<size_t>(std::clamp(v, 0, h - 1)) * w + u;
      const bool seen = v >= 0 && v < h && inverse_depth[at] > 0;
      near[u + 1] = seen ? inverse_depth[at] : 0.0f;
      far[u + 1] = seen ? inverse_depth[at] : kNone;
      dark[u + 1] = seen ? grey[at] : kNone;
      bright[u + 1] = seen ? grey[at] : -kNone;
    }
    range_row(near.data(), far.data(), dark.data(), bright.data(), w, &ranges[(v + 3) % 3]);
  };
  find_range(-1);
  find_range(0);
  for (int v = 0; v < h; ++v) {
    find_range(v + 1);
    const size_t at = static_cast<size_t>(v) * w;
    const CompareRow row{&inverse_depth[at],       &image.inverse_depth[at], &image.grey[at],
                         &ranges[(v + 2) % 3],     &ranges[v % 3],           &ranges[(v + 1) % 3],
                         &maps.depth_sigma[at],    &maps.color[at],          &maps.valid[at]};
    compare_row(&row, w, s.gain, s.bias, depth_noise);
  }
  return maps;
}

// ---------------------------------------------------------------------------- Python

Matrix4 matrix_of(const py::array_t<double, py::array::c_style | py::array::forcecast>& array,
                  const char* name) {
  if (array.ndim() != 2 || array.shape(0) != 4 || array.shape(1) != 4)
    throw py::value_error(std::string(name) + ": expected shape (4, 4)");
  Matrix4 out;
  std::copy_n(array.data(), 16, out.begin());
  return out;
}

template <typename T>
py::array_t<T> plane_array(const std::vector<T>& plane, int height, int width) {
  return py::array_t<T>({height, width}, plane.data());
}

py::dict totals_dict(const Totals& totals, float median_I, float median_D) {
  py::dict out;
  out["cost"] = totals.cost;
  out["weight"] = totals.weight;
  out["compared"] = totals.compared;
  out["inliers"] = totals.inliers;
  out["in_view"] = totals.in_view;
  out["reference"] = totals.reference;
  out["median_intensity"] = median_I;
  out["median_inverse_depth"] = median_D;
  return out;
}

using Array = py::array_t<double, py::array::c_style | py::array::forcecast>;

Appearance appearance_of(double gain, double bias, const std::array<double, kPattern>& pattern) {
  return {gain, bias, pattern[0], pattern[1], pattern[2]};
}

py::dict normal_equations(Pyramid& reference, Pyramid& current, int reference_level,
                          int current_level, const Array& T, double gain, double bias,
                          const std::array<double, kPattern>& pattern, double intensity_scale,
                          double inverse_depth_scale, const Params& params) {
  const Scales scales{static_cast<float>(intensity_scale),
                      static_cast<float>(inverse_depth_scale)};
  const State state = state_of(matrix_of(T, "T_current_reference"),
                               appearance_of(gain, bias, pattern), scales, current.sweep);
  Samples samples;
  const Totals totals = accumulate(points_of(reference, reference_level),
                                   current.levels.at(current_level), state, params, samples);
  py::dict out = totals_dict(totals, Samples::median(samples.I), Samples::median(samples.D));
  out["information"] = py::array_t<double>({kUnknowns, kUnknowns}, &totals.H[0][0]);
  out["gradient"] = py::array_t<double>(kUnknowns, totals.g);
  return out;
}

py::dict align(Pyramid& reference, Pyramid& current,
               const std::vector<std::pair<int, int>>& pairs, const Array& T_init,
               const py::object& T_prior, const py::object& information, const Params& params) {
  Prior prior;
  if (!information.is_none()) {
    prior.active = true;
    prior.T = matrix_of(T_prior.cast<Array>(), "T_prior");
    const Array values = information.cast<Array>();
    if (values.size() != 36) throw py::value_error("information: expected shape (6, 6)");
    std::copy_n(values.data(), 36, prior.information.begin());
  }
  if (pairs.empty()) throw py::value_error("no level of the two images is to be compared");
  const Matrix4 start = matrix_of(T_init, "T_current_reference_init");
  Solution solution;
  {
    py::gil_scoped_release release;
    solution = run_alignment(reference, current, pairs, start, prior, params);
  }
  py::dict out = totals_dict(solution.totals, solution.median_I, solution.median_D);
  out["agreed"] = py::array_t<double>({kUnknowns, kUnknowns}, &solution.agreement.H[0][0]);
  out["texture"] = solution.agreement.texture;
  out["T"] = py::array_t<double>({4, 4}, solution.T.data());
  out["gain"] = solution.appearance[0];
  out["bias"] = solution.appearance[1];
  out["pattern"] = py::array_t<double>(kPattern, solution.appearance.data() + 2);
  out["iterations"] = solution.iterations;
  out["converged"] = solution.converged;
  return out;
}

py::dict cells(Pyramid& reference, Pyramid& current, int reference_level, int current_level,
               const Array& T, double gain, double bias,
               const std::array<double, kPattern>& pattern, int size, const Params& params) {
  Params equal = params;  // depth weighs as its noise says
  equal.depth_weight = 1.0;
  const Scales scales{static_cast<float>(params.intensity_noise),
                      static_cast<float>(params.depth_noise)};
  State state = state_of(matrix_of(T, "T_current_reference"),
                         appearance_of(gain, bias, pattern), scales, current.sweep);
  state.least_static = 1.0f;
  const Level& level = current.levels.at(current_level);
  std::vector<Cell> found;
  {
    py::gil_scoped_release release;
    found = accumulate_cells(points_of(reference, reference_level), level, state, equal, size);
  }
  const int n = static_cast<int>(found.size());
  const int columns = (level.width + size - 1) / size;
  py::array_t<double> H({n, 6, 6}), g({n, 6}), cost(n), weight(n), depth(n), seen(n);
  for (int k = 0; k < n; ++k) {
    const Cell& cell = found[k];
    std::copy_n(&cell.H[0][0], 36, H.mutable_data(k));
    std::copy_n(cell.g, 6, g.mutable_data(k));
    cost.mutable_at(k) = cell.cost;
    weight.mutable_at(k) = cell.weight;
    depth.mutable_at(k) = cell.depth;
    seen.mutable_at(k) = cell.seen;
  }
  py::dict out;
  out["information"] = H;
  out["gradient"] = g;
  out["cost"] = cost;
  out["weight"] = weight;
  out["depth_m"] = depth;
  out["seen"] = seen;
  out["columns"] = columns;
  return out;
}

py::tuple residual_maps(Pyramid& reference, Pyramid& current, int reference_level,
                        int current_level, const Array& T, double gain, double bias,
                        const Params& params) {
  const State state = state_of(matrix_of(T, "T_current_reference"),
                               appearance_of(gain, bias, {0, 0, 0}), Scales(), current.sweep);
  const Level& target = current.levels.at(current_level);
  Maps maps;
  {
    py::gil_scoped_release release;
    const size_t n = static_cast<size_t>(target.width) * target.height;
    Plane inverse_depth(n), grey(n);
    splat(points_of(reference, reference_level), target, state, 0.5f, inverse_depth, grey);
    maps = compare(target, inverse_depth, grey, state, static_cast<float>(params.depth_noise));
  }
  return py::make_tuple(plane_array(maps.depth_sigma, target.height, target.width),
                        plane_array(maps.color, target.height, target.width),
                        plane_array(maps.valid, target.height, target.width));
}

}  // namespace

PYBIND11_MODULE(_aligner, m) {
  m.doc() = "Direct RGB-D alignment; the readable twin is bdgs_ros.tracking.align_numpy.";
  py::class_<Params>(m, "Params")
      .def(py::init<>())
      .def_readwrite("max_iterations", &Params::max_iterations)
      .def_readwrite("stop_px", &Params::stop_px)
      .def_readwrite("dof", &Params::dof)
      .def_readwrite("intensity_noise", &Params::intensity_noise)
      .def_readwrite("pixel_noise", &Params::pixel_noise)
      .def_readwrite("depth_noise", &Params::depth_noise)
      .def_readwrite("depth_weight", &Params::depth_weight)
      .def_readwrite("shade", &Params::shade)
      .def_readwrite("pattern_information", &Params::pattern_information)
      .def_readwrite("inlier_intensity", &Params::inlier_intensity)
      .def_readwrite("inlier_depth_sigma", &Params::inlier_depth_sigma)
      .def_readwrite("min_static", &Params::min_static)
      .def_readwrite("max_points", &Params::max_points);
  auto plane = [](Plane Images::*member) {
    return [member](const Level& l) { return plane_array((*l.images).*member, l.height, l.width); };
  };
  py::class_<Level>(m, "Level")
      .def_readonly("width", &Level::width)
      .def_readonly("height", &Level::height)
      .def_property_readonly(
          "intrinsics", [](const Level& l) { return py::make_tuple(l.fx, l.fy, l.cx, l.cy); })
      .def_property_readonly("grey", plane(&Images::grey))
      .def_property_readonly("gx", plane(&Images::gx))
      .def_property_readonly("gy", plane(&Images::gy))
      .def_property_readonly("inverse_depth", plane(&Images::inverse_depth))
      .def_property_readonly("smooth", plane(&Images::smooth))
      .def_property_readonly("dx", plane(&Images::dx))
      .def_property_readonly("dy", plane(&Images::dy))
      .def_property_readonly(
          "p_static", [](const Level& l) { return plane_array(l.p_static, l.height, l.width); });
  py::class_<Pyramid>(m, "Pyramid")
      .def("__len__", [](const Pyramid& p) { return p.levels.size(); })
      .def(
          "level", [](Pyramid& p, int i) -> Level& { return p.levels.at(i); },
          py::return_value_policy::reference_internal);
  m.def("build_pyramid", &build_pyramid, py::arg("image"), py::arg("depth_m"),
        py::arg("p_dynamic").none(true), py::arg("width"), py::arg("height"), py::arg("fx"),
        py::arg("fy"), py::arg("cx"), py::arg("cy"), py::arg("block"), py::arg("n_levels"),
        py::arg("depth_noise"), py::arg("sweep"));
  m.def("with_dynamic", &with_dynamic);
  m.def("normal_equations", &normal_equations);
  m.def("align", &align);
  m.def("cells", &cells);
  m.def("residual_maps", &residual_maps);
}
