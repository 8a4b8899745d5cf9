// From the sums over pixels to gradients, or at once to a step of Adam; and the view's own step.

#pragma once

#include "loss.cuh"

namespace bdgs {

// What a view is optimised with, doubles of the device's memory.
enum ViewState {
  kPose = 0,  // T_camera_world, row-major
  kPoseFirst = 16, kPoseSecond = 22,
  kExposure = 28,  // log gain, offset
  kExposureFirst = 30, kExposureSecond = 32,
  kViewState = 34
};

enum Result {  // doubles that a step leaves
  kTotal, kL1, kSsim, kDepth, kSmooth, kEmpty, kGradientGain, kGradientOffset, kGradientPose,
  kResults = kGradientPose + 6
};

struct GradientArrays {
  float *means, *quats, *log_scales, *logit_opacities, *colors, *visibility;
};

constexpr int kPartials = 8;  // six of the pose, two regularisers

struct Adam {
  float beta1, beta2, eps;

  template <typename Real>
  __device__ Real step(Real gradient, Real& first, Real& second, Real rate) const {
    first = beta1 * first + (1 - Real(beta1)) * gradient;
    second = beta2 * second + (1 - Real(beta2)) * gradient * gradient;
    return -rate * first / (sqrt(second) + Real(eps));
  }
};

// Five arrays that are optimised: values, moments and rates in the order of `Gaussians`.
struct Optimised {
  float *values[5], *first[5], *second[5];
  float rate[5];
  Adam adam;
  const uint8_t* penalised;  // members of G_D, which lose opacity
  float dynamic, reg;        // weights of the direct terms, per pixel
  float *by_color;           // also wanted: dL/dcolor, null if not
  float *pull, *views;       // null: not gathered; see bdgs_ros.mapping.densify
  float* visibility;         // null: not wanted
};

// Gradients of Gaussian i; false where no pixel shows it.
__device__ inline bool gradients_of(const Gaussians& in, int i, const Pose& pose,
                                    const Camera& camera, const float* sums, bool drawn,
                                    ParameterGradients& d) {
  const float* m = sums + static_cast<size_t>(kSums) * i;
  if (!drawn || !(m[kSumWeight] > 0.0f)) return false;
  const Ellipse e = project(in, i, pose, camera);
  project_backward(e, pose, camera, m, d);
  return true;
}

__global__ void __launch_bounds__(kPerBlock)
    gradients_kernel(Gaussians in, Camera camera, const double* T, const uint32_t* tiles,
                     const float* sums, GradientArrays out, double* partial) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  const Pose pose(T);
  ParameterGradients d = {};
  if (i < in.count) {
    gradients_of(in, i, pose, camera, sums, tiles[i] > 0, d);
    const float* m = sums + static_cast<size_t>(kSums) * i;
    for (int k = 0; k < 3; ++k) {
      out.means[3 * static_cast<size_t>(i) + k] = d.mean[k];
      out.log_scales[3 * static_cast<size_t>(i) + k] = d.log_scale[k];
      out.colors[3 * static_cast<size_t>(i) + k] = m[kRed + k];
    }
    for (int k = 0; k < 4; ++k) out.quats[4 * static_cast<size_t>(i) + k] = d.quat[k];
    out.logit_opacities[i] = d.logit_opacity;
    out.visibility[i] = m[kSumWeight];
  }
  double values[kPartials] = {};
  for (int k = 0; k < 6; ++k) values[k] = d.pose[k];
  block_sums<kPartials, kPerBlock>(values, partial + kPartials * static_cast<size_t>(blockIdx.x));
}

template <int kColumns>
__device__ inline void adam_row(const Optimised& o, int array, int i, const float* gradient) {
  for (int k = 0; k < kColumns; ++k) {
    const size_t at = static_cast<size_t>(kColumns) * i + k;
    o.values[array][at] +=
        o.adam.step(gradient[k], o.first[array][at], o.second[array][at], o.rate[array]);
  }
}

// One step of Adam on every Gaussian that the view shows or Eq. 7 penalises.
__global__ void __launch_bounds__(kPerBlock)
    update_kernel(Gaussians in, Camera camera, const double* T, const uint32_t* tiles,
                  const float* sums, Optimised o, double* partial) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  const Pose pose(T);
  ParameterGradients d = {};
  double values[kPartials] = {};
  if (i < in.count) {
    const bool seen = gradients_of(in, i, pose, camera, sums, tiles[i] > 0, d);
    for (int k = 0; k < 6; ++k) values[k] = d.pose[k];
    const bool penalised = o.penalised != nullptr && o.penalised[i];
    if (penalised) {
      const float alpha = 1.0f / (1.0f + expf(-in.logit_opacities[i]));
      const float weighted = o.dynamic * in.p_dynamic[i] * alpha * alpha;
      d.logit_opacity += 2.0f * weighted * (1.0f - alpha);
      values[6] = weighted;
    }
    for (int k = 0; k < 3; ++k) {
      const float fourth = expf(4.0f * in.log_scales[3 * static_cast<size_t>(i) + k]);
      d.log_scale[k] += 4.0f * o.reg * fourth;
      values[7] += o.reg * fourth;
    }
    if (o.visibility != nullptr)
      o.visibility[i] = seen ? sums[static_cast<size_t>(kSums) * i + kSumWeight] : 0.0f;
    if (seen && o.pull != nullptr) {
      const float* g = d.mean;
      o.pull[i] += sqrtf(g[0] * g[0] + g[1] * g[1] + g[2] * g[2]) *
                   fabsf(camera_z(in, i, pose)) / camera.fx;
      o.views[i] += 1.0f;
    }
    const float* color = sums + static_cast<size_t>(kSums) * i + kRed;
    const float none[3] = {};
    if (o.by_color != nullptr)
      for (int k = 0; k < 3; ++k)
        o.by_color[3 * static_cast<size_t>(i) + k] = seen ? color[k] : 0.0f;
    if (seen || penalised) {
      adam_row<3>(o, 0, i, d.mean);
      adam_row<4>(o, 1, i, d.quat);
      adam_row<3>(o, 2, i, d.log_scale);
      adam_row<1>(o, 3, i, &d.logit_opacity);
      adam_row<3>(o, 4, i, seen ? color : none);
    }
  }
  block_sums<kPartials, kPerBlock>(values, partial + kPartials * static_cast<size_t>(blockIdx.x));
}

struct Partials {
  const double *gaussians, *ssim, *pixels;  // kPartials, 1 and kLossSums columns
  int blocks, tiles;
};

// exp(xi) T for xi = (rho, phi).
__device__ inline void move_pose(const double* xi, double* T) {
  const double *rho = xi, *phi = xi + 3;
  const double angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2];
  const double angle = sqrt(angle2);
  const bool small = angle < 1e-6;
  const double a = small ? 1.0 - angle2 / 6.0 : sin(angle) / angle;
  const double b = small ? 0.5 - angle2 / 24.0 : (1.0 - cos(angle)) / angle2;
  const double c = small ? 1.0 / 6.0 - angle2 / 120.0 : (1.0 - a) / angle2;
  const double hat[9] = {0, -phi[2], phi[1], phi[2], 0, -phi[0], -phi[1], phi[0], 0};
  double R[9], V[9], moved[12];
  for (int r = 0; r < 3; ++r)
    for (int k = 0; k < 3; ++k) {
      double square = 0;
      for (int j = 0; j < 3; ++j) square += hat[3 * r + j] * hat[3 * j + k];
      const double one = r == k ? 1.0 : 0.0;
      R[3 * r + k] = one + a * hat[3 * r + k] + b * square;
      V[3 * r + k] = one + b * hat[3 * r + k] + c * square;
    }
  for (int r = 0; r < 3; ++r)
    for (int k = 0; k < 4; ++k) {
      moved[4 * r + k] = k < 3 ? 0.0 : V[3 * r] * rho[0] + V[3 * r + 1] * rho[1] +
                                           V[3 * r + 2] * rho[2];
      for (int j = 0; j < 3; ++j) moved[4 * r + k] += R[3 * r + j] * T[4 * j + k];
    }
  for (int k = 0; k < 12; ++k) T[k] = moved[k];
}

struct ViewRates {
  double pose, exposure;  // 0: stays
  Adam pose_adam, exposure_adam;
};

// Total of a column of partial sums, in a fixed order; every thread returns it.
template <int kThreads>
__device__ inline double column_sum(const double* partial, int rows, int columns, int column) {
  __shared__ double shared[kThreads];
  double sum = 0;
  for (int row = threadIdx.x; row < rows; row += kThreads)
    sum += partial[static_cast<size_t>(row) * columns + column];
  __syncthreads();
  shared[threadIdx.x] = sum;
  __syncthreads();
  for (int half = kThreads / 2; half > 0; half /= 2) {
    if (static_cast<int>(threadIdx.x) < half) shared[threadIdx.x] += shared[threadIdx.x + half];
    __syncthreads();
  }
  return shared[0];
}

// Add up what the blocks found, and let the view's pose and exposure follow.
__global__ void __launch_bounds__(kTilePixels)
    view_kernel(Partials p, LossWeights weights, const float* per_weight, double* state,
                ViewRates rates, double* result) {
  double found[kResults] = {}, direct = 0;
  if (p.pixels != nullptr) {
    const double per[kLossSums] = {per_weight[0], 1, per_weight[1], per_weight[0], per_weight[1],
                                   1,             1};
    const int places[kLossSums] = {kL1, kSsim, kDepth, kSmooth, kEmpty, kGradientGain,
                                   kGradientOffset};
    for (int k = 0; k < kLossSums; ++k)
      if (k != kLossSsim)
        found[places[k]] = per[k] * column_sum<kTilePixels>(p.pixels, p.tiles, kLossSums, k);
    found[kSsim] = per_weight[0] * column_sum<kTilePixels>(p.ssim, p.tiles, 1, 0);
  }
  for (int k = 0; k < kPartials; ++k) {
    const double sum = column_sum<kTilePixels>(p.gaussians, p.blocks, kPartials, k);
    if (k < 6)
      found[kGradientPose + k] = sum;
    else
      direct += sum;
  }
  if (threadIdx.x != 0) return;
  found[kTotal] = weights.l1 * found[kL1] + weights.ssim * found[kSsim] +
                  weights.depth * found[kDepth] + weights.smooth * found[kSmooth] +
                  weights.empty * found[kEmpty] + direct;
  for (int k = 0; k < kResults; ++k) result[k] = found[k];
  if (rates.exposure > 0)
    for (int k = 0; k < 2; ++k)
      state[kExposure + k] +=
          rates.exposure_adam.step(found[kGradientGain + k], state[kExposureFirst + k],
                                   state[kExposureSecond + k], rates.exposure);
  if (rates.pose >= 0) {  // with a rate of 0 the moments follow all the same
    double xi[6];
    for (int k = 0; k < 6; ++k)
      xi[k] = rates.pose_adam.step(found[kGradientPose + k], state[kPoseFirst + k],
                                   state[kPoseSecond + k], rates.pose);
    if (rates.pose > 0) move_pose(xi, state + kPose);
  }
}

}  // namespace bdgs
