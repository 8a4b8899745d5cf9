// From the parameters of kLanes Gaussians to their ellipses in the image, and the way back.
//
//   R(q)            rotation of the normalised quaternion, wxyz
//   M = W R diag(s) W is the camera's rotation, so the covariance in the camera is M M^T
//   p = W mean + t  centre in the camera
//   U = J M         J is the Jacobian of the projection at p, with x/z and y/z held inside the
//                   image widened by 0.15 of its size on each side (1.3 times the field of view)
//   S = U U^T + 0.3 covariance in the image in px^2, widened by a low-pass filter
//   zeta = S^-1 U m m is the row of M for camera z, so U m is the covariance of z with the image
//                   position: z + zeta . (pixel - centre) is the mean of z given the pixel. On a
//                   flat Gaussian that is its tangent plane; the low-pass keeps edge-on ones
//                   bounded, by sqrt(var z) per standard deviation of S.
//
// det S is summed from positive terms, |U0 x U1|^2 + 0.3 (|U0|^2 + |U1|^2) + 0.09, because
// S00 S11 - S01^2 cancels in float32 for long thin ellipses.

#pragma once

#include "rasterizer_simd.hpp"

namespace bdgs {

constexpr float kNear = 0.05f;             // m: Gaussians closer to the camera are not drawn
constexpr float kLowPass = 0.3f;           // px^2
constexpr float kMinAlpha = 1.0f / 255.0f; // fainter contributions are skipped
constexpr float kLn2 = 0.6931471805599453f;

struct View {
  int width, height;
  float fx, fy, cx, cy;
  float rotation[9], translation[3];  // of T_camera_world
  float min_x, max_x, min_y, max_y;   // where x/z and y/z are clamped for J

  void set_limits() {
    const float margin_x = 0.15f * width / fx, margin_y = 0.15f * height / fy;
    min_x = -cx / fx - margin_x;
    max_x = (width - cx) / fx + margin_x;
    min_y = -cy / fy - margin_y;
    max_y = (height - cy) / fy + margin_y;
  }
};

// Pointers to the caller's arrays, row-major float32.
struct Parameters {
  const float *means, *quats, *log_scales, *logit_opacities, *colors, *p_dynamic;
  const uint8_t* active;  // null: all
  int count;
};

struct Ellipses {
  Lanes mean[3], quat[4], inverse_norm;  // quat is normalised
  Lanes x, y, z, inverse_z;              // camera, m
  Lanes u, v;                            // px
  Lanes scale[3];                        // m
  Lanes N[9], M[9];                      // W R and W R diag(s), row-major
  Lanes slope_x, slope_y;                // x/z and y/z, clamped
  Mask clamped_x, clamped_y;
  Lanes U[6];
  Lanes s00, s01, s11, inverse_det;      // S and 1 / det S
  Lanes zeta_u, zeta_v;                  // dz/du and dz/dv, m per px
  Lanes opacity;
};

inline void rotation_of(const Lanes* q, Lanes* R) {
  const Lanes w = q[0], x = q[1], y = q[2], z = q[3];
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

inline Lanes sigmoid(Lanes logit) {
  const Lanes limited = min(splat(80.0f), max(splat(-80.0f), logit));
  return 1.0f / (1.0f + exp2(limited * -kLog2E));
}

inline void transform_means(const Parameters& in, int i, const View& view, Ellipses& e) {
  load_rows<3>(in.means, i, in.count, e.mean);
  const float *W = view.rotation, *t = view.translation;
  e.x = W[0] * e.mean[0] + W[1] * e.mean[1] + W[2] * e.mean[2] + t[0];
  e.y = W[3] * e.mean[0] + W[4] * e.mean[1] + W[5] * e.mean[2] + t[1];
  e.z = W[6] * e.mean[0] + W[7] * e.mean[1] + W[8] * e.mean[2] + t[2];
}

// Fill the rest of `e` after transform_means. Lanes behind the near plane hold rubbish.
inline void project(const Parameters& in, int i, const View& view, Ellipses& e) {
  load_rows<4>(in.quats, i, in.count, e.quat);
  const Lanes* q = e.quat;
  const Lanes norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  e.inverse_norm = 1.0f / max(norm, splat(1e-12f));
  for (int k = 0; k < 4; ++k) e.quat[k] *= e.inverse_norm;
  load_rows<3>(in.log_scales, i, in.count, e.scale);
  for (int k = 0; k < 3; ++k)
    e.scale[k] = exp2(min(splat(40.0f), max(splat(-40.0f), e.scale[k] * kLog2E)));
  load_rows<1>(in.logit_opacities, i, in.count, &e.opacity);
  e.opacity = sigmoid(e.opacity);

  Lanes R[9];
  rotation_of(e.quat, R);
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) {
      const float* W = view.rotation + 3 * r;
      e.N[3 * r + c] = W[0] * R[c] + W[1] * R[3 + c] + W[2] * R[6 + c];
      e.M[3 * r + c] = e.N[3 * r + c] * e.scale[c];
    }

  e.inverse_z = 1.0f / e.z;
  const Lanes slope_x = e.x * e.inverse_z, slope_y = e.y * e.inverse_z;
  e.u = view.fx * slope_x + view.cx;
  e.v = view.fy * slope_y + view.cy;
  e.slope_x = min(max(slope_x, splat(view.min_x)), splat(view.max_x));
  e.slope_y = min(max(slope_y, splat(view.min_y)), splat(view.max_y));
  e.clamped_x = e.slope_x != slope_x;
  e.clamped_y = e.slope_y != slope_y;

  const Lanes jx = view.fx * e.inverse_z, jy = view.fy * e.inverse_z;
  for (int c = 0; c < 3; ++c) {
    e.U[c] = jx * (e.M[c] - e.slope_x * e.M[6 + c]);
    e.U[3 + c] = jy * (e.M[3 + c] - e.slope_y * e.M[6 + c]);
  }
  const Lanes *a = e.U, *b = e.U + 3;
  const Lanes aa = a[0] * a[0] + a[1] * a[1] + a[2] * a[2];
  const Lanes bb = b[0] * b[0] + b[1] * b[1] + b[2] * b[2];
  const Lanes cross[3] = {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
                          a[0] * b[1] - a[1] * b[0]};
  e.s00 = aa + kLowPass;
  e.s01 = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  e.s11 = bb + kLowPass;
  e.inverse_det = 1.0f / (cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2] +
                          kLowPass * (aa + bb) + kLowPass * kLowPass);

  const Lanes* m = e.M + 6;
  const Lanes c0 = m[0] * a[0] + m[1] * a[1] + m[2] * a[2];
  const Lanes c1 = m[0] * b[0] + m[1] * b[1] + m[2] * b[2];
  e.zeta_u = (e.s11 * c0 - e.s01 * c1) * e.inverse_det;
  e.zeta_v = (e.s00 * c1 - e.s01 * c0) * e.inverse_det;
}

// What the pixels say about kLanes Gaussians: sums over pixels, with g = dL/d(exponent),
// d = pixel - centre in px, w = blending weight.
struct Moments {
  Lanes g, gx, gy, gxx, gxy, gyy;  // g, g dx, g dy, g dx^2, g dx dy, g dy^2
  Lanes color[3];                  // w dL/dcolor
  Lanes depth, depth_x, depth_y;   // q, q dx, q dy with q = w dL/ddepth
  Lanes weight;                    // w
};

struct ParameterGradients {
  Lanes mean[3], quat[4], log_scale[3], logit_opacity;
  Lanes pose[6];  // of T_camera_world <- exp(rho, phi) T_camera_world
};

// Through R(q) and the normalisation: dR, row-major, to the raw quaternion.
inline void quaternion_gradient(const Ellipses& e, const Lanes* dR, Lanes* out) {
  const Lanes w = e.quat[0], x = e.quat[1], y = e.quat[2], z = e.quat[3];
  Lanes d[4];
  d[0] = 2.0f * (x * (dR[7] - dR[5]) + y * (dR[2] - dR[6]) + z * (dR[3] - dR[1]));
  d[1] = 2.0f * (y * (dR[1] + dR[3]) + z * (dR[2] + dR[6]) + w * (dR[7] - dR[5]) -
                 2.0f * x * (dR[4] + dR[8]));
  d[2] = 2.0f * (x * (dR[1] + dR[3]) + z * (dR[5] + dR[7]) + w * (dR[2] - dR[6]) -
                 2.0f * y * (dR[0] + dR[8]));
  d[3] = 2.0f * (x * (dR[2] + dR[6]) + y * (dR[5] + dR[7]) + w * (dR[3] - dR[1]) -
                 2.0f * z * (dR[0] + dR[4]));
  const Lanes along = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
  for (int k = 0; k < 4; ++k) out[k] = (d[k] - along * e.quat[k]) * e.inverse_norm;
}

inline void project_backward(const Ellipses& e, const View& view, const Moments& m,
                             ParameterGradients& out) {
  // exponent = -1/2 d^T K d with K = S^-1
  const Lanes k00 = e.s11 * e.inverse_det, k01 = -e.s01 * e.inverse_det,
              k11 = e.s00 * e.inverse_det;
  const Lanes du = k00 * m.gx + k01 * m.gy - e.zeta_u * m.depth;
  const Lanes dv = k01 * m.gx + k11 * m.gy - e.zeta_v * m.depth;
  // dL/dS = 1/2 K (sum g d d^T) K
  const Lanes p00 = k00 * m.gxx + k01 * m.gxy, p01 = k00 * m.gxy + k01 * m.gyy;
  const Lanes p10 = k01 * m.gxx + k11 * m.gxy, p11 = k01 * m.gxy + k11 * m.gyy;
  Lanes h00 = p00 * k00 + p01 * k01, h01 = p00 * k01 + p01 * k11,
        h11 = p10 * k01 + p11 * k11;  // 2 dL/dS
  // zeta = K c with c = U m: dL/dc = K dL/dzeta = r, and dL/dS gets -1/2 (r zeta^T + zeta r^T)
  const Lanes r0 = k00 * m.depth_x + k01 * m.depth_y, r1 = k01 * m.depth_x + k11 * m.depth_y;
  h00 -= 2.0f * r0 * e.zeta_u;
  h01 -= r0 * e.zeta_v + r1 * e.zeta_u;
  h11 -= 2.0f * r1 * e.zeta_v;

  const Lanes jx = view.fx * e.inverse_z, jy = view.fy * e.inverse_z;
  Lanes dM[9], dslope_x = Lanes{}, dslope_y = Lanes{}, djx = Lanes{}, djy = Lanes{};
  for (int c = 0; c < 3; ++c) {
    const Lanes dU0 = h00 * e.U[c] + h01 * e.U[3 + c] + r0 * e.M[6 + c];
    const Lanes dU1 = h01 * e.U[c] + h11 * e.U[3 + c] + r1 * e.M[6 + c];
    dM[c] = jx * dU0;
    dM[3 + c] = jy * dU1;
    dM[6 + c] = r0 * e.U[c] + r1 * e.U[3 + c] - (e.slope_x * dM[c] + e.slope_y * dM[3 + c]);
    dslope_x -= dM[c] * e.M[6 + c];
    dslope_y -= dM[3 + c] * e.M[6 + c];
    djx += dU0 * e.U[c];  // U0 = jx (...), so this is jx dL/djx
    djy += dU1 * e.U[3 + c];
  }
  // u = fx x/z + cx always moves with x/z; the clamped slope of J does not
  const Lanes zero = Lanes{};
  const Lanes sx = view.fx * du + (e.clamped_x ? zero : dslope_x);
  const Lanes sy = view.fy * dv + (e.clamped_y ? zero : dslope_y);
  const Lanes dx = sx * e.inverse_z, dy = sy * e.inverse_z;
  const Lanes dz = m.depth - (dx * e.x + dy * e.y + djx + djy) * e.inverse_z;

  const float* W = view.rotation;
  for (int k = 0; k < 3; ++k) out.mean[k] = W[k] * dx + W[3 + k] * dy + W[6 + k] * dz;
  out.logit_opacity = m.g * (1.0f - e.opacity);

  Lanes dN[9], dR[9];
  for (int c = 0; c < 3; ++c) {
    out.log_scale[c] = Lanes{};
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
  for (int c = 0; c < 3; ++c) {  // M turns with the camera: phi gets M[:, c] x dM[:, c]
    out.pose[3] += e.M[3 + c] * dM[6 + c] - e.M[6 + c] * dM[3 + c];
    out.pose[4] += e.M[6 + c] * dM[c] - e.M[c] * dM[6 + c];
    out.pose[5] += e.M[c] * dM[3 + c] - e.M[3 + c] * dM[c];
  }
}

}  // namespace bdgs
