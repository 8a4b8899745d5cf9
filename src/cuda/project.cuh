// From one Gaussian's parameters to its ellipse in the image, and the way back: the formulas of
// ../rasterizer_project.hpp, which explains them, one Gaussian per thread.

#pragma once

#include "platform.cuh"

namespace bdgs {

constexpr float kNear = 0.05f;
constexpr float kLowPass = 0.3f;
constexpr float kMinAlpha = 1.0f / 255.0f;
constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;
constexpr float kLn2 = 0.6931471805599453f, kLog2E = 1.4426950408889634f;

struct Camera {
  int width, height;
  float fx, fy, cx, cy;
  float min_x, max_x, min_y, max_y;  // where x/z and y/z are held for the Jacobian

  void set_limits() {
    const float margin_x = 0.15f * width / fx, margin_y = 0.15f * height / fy;
    min_x = -cx / fx - margin_x;
    max_x = (width - cx) / fx + margin_x;
    min_y = -cy / fy - margin_y;
    max_y = (height - cy) / fy + margin_y;
  }
};

// T_camera_world, from doubles in the device's memory.
struct Pose {
  float R[9], t[3];

  __device__ explicit Pose(const double* T) {
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) R[3 * r + c] = static_cast<float>(T[4 * r + c]);
      t[r] = static_cast<float>(T[4 * r + 3]);
    }
  }
};

// Arrays of the device, row-major float32.
struct Gaussians {
  const float *means, *quats, *log_scales, *logit_opacities, *colors, *p_dynamic;
  const uint8_t* active;  // null: all
  float min_logit;        // fainter ones are not drawn
  int count;
};

struct Ellipse {
  float quat[4], inverse_norm;
  float x, y, z, inverse_z;
  float u, v;
  float scale[3];
  float M[9];
  float slope_x, slope_y;
  bool clamped_x, clamped_y;
  float U[6];
  float s00, s01, s11, inverse_det;
  float zeta_u, zeta_v;
  float opacity;
};

__device__ inline float camera_z(const Gaussians& in, int i, const Pose& pose) {
  const float* m = in.means + 3 * static_cast<size_t>(i);
  return pose.R[6] * m[0] + pose.R[7] * m[1] + pose.R[8] * m[2] + pose.t[2];
}

__device__ inline float hold(float v, float low, float high) { return fminf(fmaxf(v, low), high); }

__device__ inline void rotation_of(const float* q, float* R) {
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  R[0] = 1.0f - 2.0f * (y * y + z * z);
  R[1] = 2.0f * (x * y - w * z);
  R[2] = 2.0f * (x * z + w * y);
  R[3] = 2.0f * (x * y + w * z);
  R[4] = 1.0f - 2.0f * (x * x + z * z);
  R[5] = 2.0f * (y * z - w * x);
  R[6] = 2.0f * (x * z - w * y);
  R[7] = 2.0f * (y * z + w * x);
  R[8] = 1.0f - 2.0f * (x * x + y * y);
}

__device__ inline Ellipse project(const Gaussians& in, int i, const Pose& pose,
                                  const Camera& camera) {
  Ellipse e;
  const size_t at = static_cast<size_t>(i);
  const float *mean = in.means + 3 * at, *W = pose.R, *t = pose.t;
  e.x = W[0] * mean[0] + W[1] * mean[1] + W[2] * mean[2] + t[0];
  e.y = W[3] * mean[0] + W[4] * mean[1] + W[5] * mean[2] + t[1];
  e.z = camera_z(in, i, pose);

  for (int k = 0; k < 4; ++k) e.quat[k] = in.quats[4 * at + k];
  const float* q = e.quat;
  e.inverse_norm = 1.0f / fmaxf(sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]),
                                1e-12f);
  for (int k = 0; k < 4; ++k) e.quat[k] *= e.inverse_norm;
  for (int k = 0; k < 3; ++k)
    e.scale[k] = exp2f(hold(in.log_scales[3 * at + k] * kLog2E, -40.0f, 40.0f));
  e.opacity = 1.0f / (1.0f + exp2f(-kLog2E * hold(in.logit_opacities[i], -80.0f, 80.0f)));

  float R[9];
  rotation_of(e.quat, R);
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c)
      e.M[3 * r + c] =
          (W[3 * r] * R[c] + W[3 * r + 1] * R[3 + c] + W[3 * r + 2] * R[6 + c]) * e.scale[c];

  e.inverse_z = 1.0f / e.z;
  const float slope_x = e.x * e.inverse_z, slope_y = e.y * e.inverse_z;
  e.u = camera.fx * slope_x + camera.cx;
  e.v = camera.fy * slope_y + camera.cy;
  e.slope_x = hold(slope_x, camera.min_x, camera.max_x);
  e.slope_y = hold(slope_y, camera.min_y, camera.max_y);
  e.clamped_x = e.slope_x != slope_x;
  e.clamped_y = e.slope_y != slope_y;

  const float jx = camera.fx * e.inverse_z, jy = camera.fy * e.inverse_z;
  for (int c = 0; c < 3; ++c) {
    e.U[c] = jx * (e.M[c] - e.slope_x * e.M[6 + c]);
    e.U[3 + c] = jy * (e.M[3 + c] - e.slope_y * e.M[6 + c]);
  }
  const float *a = e.U, *b = e.U + 3;
  const float aa = a[0] * a[0] + a[1] * a[1] + a[2] * a[2];
  const float bb = b[0] * b[0] + b[1] * b[1] + b[2] * b[2];
  const float n0 = a[1] * b[2] - a[2] * b[1], n1 = a[2] * b[0] - a[0] * b[2],
              n2 = a[0] * b[1] - a[1] * b[0];
  e.s00 = aa + kLowPass;
  e.s01 = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  e.s11 = bb + kLowPass;
  e.inverse_det =
      1.0f / (n0 * n0 + n1 * n1 + n2 * n2 + kLowPass * (aa + bb) + kLowPass * kLowPass);

  const float* m = e.M + 6;
  const float c0 = m[0] * a[0] + m[1] * a[1] + m[2] * a[2];
  const float c1 = m[0] * b[0] + m[1] * b[1] + m[2] * b[2];
  e.zeta_u = (e.s11 * c0 - e.s01 * c1) * e.inverse_det;
  e.zeta_v = (e.s00 * c1 - e.s01 * c0) * e.inverse_det;
  return e;
}

// What the pixels add up to, about the centre of the Gaussian: with g = dL/d(exponent),
// d = pixel - centre and w = blending weight.
enum Sum {
  kG, kGx, kGy, kGxx, kGxy, kGyy,     // g, g dx, g dy, g dx^2, g dx dy, g dy^2
  kRed, kGreen, kBlue,                // w dL/dcolor
  kSumDepth, kSumDepthX, kSumDepthY,  // q, q dx, q dy with q = w dL/ddepth
  kSumWeight,                         // w
  kSums = 16                          // with room to the next cache sector
};

struct ParameterGradients {
  float mean[3], quat[4], log_scale[3], logit_opacity;
  float pose[6];  // of T_camera_world <- exp(rho, phi) T_camera_world
};

__device__ inline void quaternion_gradient(const Ellipse& e, const float* dR, float* out) {
  const float w = e.quat[0], x = e.quat[1], y = e.quat[2], z = e.quat[3];
  float d[4];
  d[0] = 2.0f * (x * (dR[7] - dR[5]) + y * (dR[2] - dR[6]) + z * (dR[3] - dR[1]));
  d[1] = 2.0f * (y * (dR[1] + dR[3]) + z * (dR[2] + dR[6]) + w * (dR[7] - dR[5]) -
                 2.0f * x * (dR[4] + dR[8]));
  d[2] = 2.0f * (x * (dR[1] + dR[3]) + z * (dR[5] + dR[7]) + w * (dR[2] - dR[6]) -
                 2.0f * y * (dR[0] + dR[8]));
  d[3] = 2.0f * (x * (dR[2] + dR[6]) + y * (dR[5] + dR[7]) + w * (dR[3] - dR[1]) -
                 2.0f * z * (dR[0] + dR[4]));
  const float along = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
  for (int k = 0; k < 4; ++k) out[k] = (d[k] - along * e.quat[k]) * e.inverse_norm;
}

__device__ inline void project_backward(const Ellipse& e, const Pose& pose, const Camera& camera,
                                        const float* m, ParameterGradients& out) {
  const float k00 = e.s11 * e.inverse_det, k01 = -e.s01 * e.inverse_det,
              k11 = e.s00 * e.inverse_det;
  const float du = k00 * m[kGx] + k01 * m[kGy] - e.zeta_u * m[kSumDepth];
  const float dv = k01 * m[kGx] + k11 * m[kGy] - e.zeta_v * m[kSumDepth];
  const float p00 = k00 * m[kGxx] + k01 * m[kGxy], p01 = k00 * m[kGxy] + k01 * m[kGyy];
  const float p10 = k01 * m[kGxx] + k11 * m[kGxy], p11 = k01 * m[kGxy] + k11 * m[kGyy];
  float h00 = p00 * k00 + p01 * k01, h01 = p00 * k01 + p01 * k11, h11 = p10 * k01 + p11 * k11;
  const float r0 = k00 * m[kSumDepthX] + k01 * m[kSumDepthY],
              r1 = k01 * m[kSumDepthX] + k11 * m[kSumDepthY];
  h00 -= 2.0f * r0 * e.zeta_u;
  h01 -= r0 * e.zeta_v + r1 * e.zeta_u;
  h11 -= 2.0f * r1 * e.zeta_v;

  const float jx = camera.fx * e.inverse_z, jy = camera.fy * e.inverse_z;
  float dM[9], dslope_x = 0, dslope_y = 0, djx = 0, djy = 0;
  for (int c = 0; c < 3; ++c) {
    const float dU0 = h00 * e.U[c] + h01 * e.U[3 + c] + r0 * e.M[6 + c];
    const float dU1 = h01 * e.U[c] + h11 * e.U[3 + c] + r1 * e.M[6 + c];
    dM[c] = jx * dU0;
    dM[3 + c] = jy * dU1;
    dM[6 + c] = r0 * e.U[c] + r1 * e.U[3 + c] - (e.slope_x * dM[c] + e.slope_y * dM[3 + c]);
    dslope_x -= dM[c] * e.M[6 + c];
    dslope_y -= dM[3 + c] * e.M[6 + c];
    djx += dU0 * e.U[c];
    djy += dU1 * e.U[3 + c];
  }
  const float sx = camera.fx * du + (e.clamped_x ? 0.0f : dslope_x);
  const float sy = camera.fy * dv + (e.clamped_y ? 0.0f : dslope_y);
  const float dx = sx * e.inverse_z, dy = sy * e.inverse_z;
  const float dz = m[kSumDepth] - (dx * e.x + dy * e.y + djx + djy) * e.inverse_z;

  const float* W = pose.R;
  for (int k = 0; k < 3; ++k) out.mean[k] = W[k] * dx + W[3 + k] * dy + W[6 + k] * dz;
  out.logit_opacity = m[kG] * (1.0f - e.opacity);

  float dN[9], dR[9];
  for (int c = 0; c < 3; ++c) {
    out.log_scale[c] = 0.0f;
    for (int r = 0; r < 3; ++r) {
      out.log_scale[c] += dM[3 * r + c] * e.M[3 * r + c];
      dN[3 * r + c] = dM[3 * r + c] * e.scale[c];
    }
  }
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c)
      dR[3 * r + c] = W[r] * dN[c] + W[3 + r] * dN[3 + c] + W[6 + r] * dN[6 + c];
  quaternion_gradient(e, dR, out.quat);

  out.pose[0] = dx;
  out.pose[1] = dy;
  out.pose[2] = dz;
  out.pose[3] = e.y * dz - e.z * dy;
  out.pose[4] = e.z * dx - e.x * dz;
  out.pose[5] = e.x * dy - e.y * dx;
  for (int c = 0; c < 3; ++c) {
    out.pose[3] += e.M[3 + c] * dM[6 + c] - e.M[6 + c] * dM[3 + c];
    out.pose[4] += e.M[6 + c] * dM[c] - e.M[c] * dM[6 + c];
    out.pose[5] += e.M[c] * dM[3 + c] - e.M[3 + c] * dM[c];
  }
}

}  // namespace bdgs
