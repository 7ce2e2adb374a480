// SPDX-License-Identifier: Apache-2.0
// Two fits as a user of Ceres writes them: a hexapod of 42 parameters by measured poses, and a
// linear delta of 9 parameters by measured positions. Residuals are predicted minus measured,
// divided by sigma. Derivatives are analytic, those of poses by the implicit function theorem.
//
// Arguments: robot ("hexapod" or "delta"), file of numbers, repeats. The file, written by
// benchmarks/peers/__main__.py, holds n, p, the scale of each parameter (p), the start (p), and for
// every pose the readings, the measured position or (rotation vector, position), and the sigmas.
// The program prints estimate and covariance, then the processor time of every repeat [s].

#include <ceres/ceres.h>
#include <ceres/version.h>

#include <Eigen/Dense>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <string>
#include <vector>

#include "rotations.h"

namespace {

Eigen::Vector3d logarithm(const Eigen::Matrix3d& R) {
  const Eigen::Vector3d s(R(2, 1) - R(1, 2), R(0, 2) - R(2, 0), R(1, 0) - R(0, 1));
  const double sine = 0.5 * s.norm(), angle = std::atan2(sine, 0.5 * (R.trace() - 1.0));
  return sine < 1e-12 ? Eigen::Vector3d(0.5 * s) : Eigen::Vector3d(s * (0.5 * angle / sine));
}

Eigen::Matrix3d left_jacobian_inverse(const Eigen::Vector3d& v) {
  const double angle = v.norm();
  const Eigen::Matrix3d K = cross(v);
  const double factor = angle < 1e-4 ? 1.0 / 12.0
                                     : 1.0 / (angle * angle) - 0.5 / (angle * std::tan(0.5 * angle));
  return Eigen::Matrix3d::Identity() - 0.5 * K + factor * K * K;
}

// Six legs of base point, platform point and length. The pose is solved from the readings by Newton
// steps from the last solution of this pose.
class HexapodPose : public ceres::CostFunction {
 public:
  HexapodPose(const double* row, const Eigen::Matrix3d& R0, const Eigen::Vector3d& t0) : R(R0), t(t0) {
    for (int i = 0; i < 6; ++i) q[i] = row[i], weight[i] = 1.0 / row[12 + i];
    measured = exponential(Eigen::Vector3d(row[6], row[7], row[8]));
    place = Eigen::Vector3d(row[9], row[10], row[11]);
    set_num_residuals(6);
    mutable_parameter_block_sizes()->push_back(42);
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const double* x = parameters[0];
    Matrix6 A;
    Vector6 gap;
    Eigen::Vector3d unit[6];
    for (int i = 0; i < 50; ++i) {
      for (int k = 0; k < 6; ++k) {
        const Eigen::Map<const Eigen::Vector3d> base(x + 7 * k), platform(x + 7 * k + 3);
        const Eigen::Vector3d arm = R * platform, leg = t + arm - base;
        const double length = leg.norm();
        unit[k] = leg / length;
        gap[k] = length - x[7 * k + 6] - q[k];
        A.row(k) << arm.cross(unit[k]).transpose(), unit[k].transpose();
      }
      if (gap.cwiseAbs().maxCoeff() < 1e-14) break;
      const Vector6 step = -A.partialPivLu().solve(gap);
      R = exponential(step.head<3>()) * R;
      t += step.tail<3>();
    }
    const Eigen::Vector3d turn = logarithm(R * measured.transpose());
    Eigen::Map<Vector6> out(residuals);
    out << turn, t - place;
    out = out.cwiseProduct(weight);
    if (jacobians != nullptr && jacobians[0] != nullptr) {
      Eigen::Matrix<double, 6, 42> E = Eigen::Matrix<double, 6, 42>::Zero();
      for (int k = 0; k < 6; ++k) {
        E.block<1, 3>(k, 7 * k) = -unit[k].transpose();
        E.block<1, 3>(k, 7 * k + 3) = unit[k].transpose() * R;
        E(k, 7 * k + 6) = -1.0;
      }
      Matrix6 by_twist = Matrix6::Identity();
      by_twist.topLeftCorner<3, 3>() = left_jacobian_inverse(turn);
      const Matrix6 by_gap = weight.asDiagonal() * by_twist * A.inverse();
      Eigen::Map<Eigen::Matrix<double, 6, 42, Eigen::RowMajor>>(jacobians[0]).noalias() = -by_gap * E;
    }
    return true;
  }

 private:
  Vector6 q, weight;
  Eigen::Matrix3d measured;
  Eigen::Vector3d place;
  mutable Eigen::Matrix3d R;
  mutable Eigen::Vector3d t;
};

// Parameters: radius, then angle, arm and stop of towers 1 and 2, then arm and stop of tower 3,
// whose angle is 90 degrees. The nozzle is the lower point at the arms' lengths from the carriages.
struct DeltaPosition {
  DeltaPosition(const double* row) : data(row, row + 9) {}

  template <typename T>
  bool operator()(const T* x, T* residual) const {
    const T angle[3] = {x[1], x[4], T(0.5 * M_PI)}, arm[3] = {x[2], x[5], x[7]}, stop[3] = {x[3], x[6], x[8]};
    Eigen::Matrix<T, 3, 1> c[3];
    for (int k = 0; k < 3; ++k) {
      using std::cos, std::sin, std::sqrt;
      c[k] << x[0] * cos(angle[k]), x[0] * sin(angle[k]), stop[k] + sqrt(arm[k] * arm[k] - x[0] * x[0]) - T(data[k]);
    }
    const Eigen::Matrix<T, 3, 1> a = c[1] - c[0], b = c[2] - c[0];
    const T along = a.norm();
    const Eigen::Matrix<T, 3, 1> e1 = a / along;
    const T i = e1.dot(b);
    Eigen::Matrix<T, 3, 1> e2 = b - i * e1;
    const T j = e2.norm();
    e2 /= j;
    const Eigen::Matrix<T, 3, 1> e3 = e1.cross(e2);
    const T u = (arm[0] * arm[0] - arm[1] * arm[1] + along * along) / (2.0 * along);
    const T v = (arm[0] * arm[0] - arm[2] * arm[2] + i * i + j * j - 2.0 * i * u) / (2.0 * j);
    using std::sqrt;
    const T w = sqrt(arm[0] * arm[0] - u * u - v * v);
    const Eigen::Matrix<T, 3, 1> p = c[0] + u * e1 + v * e2 - w * e3;
    for (int k = 0; k < 3; ++k) residual[k] = (p[k] - T(data[3 + k])) / T(data[6 + k]);
    return true;
  }

  std::vector<double> data;
};

double processor_time() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

struct Answer {
  std::vector<double> estimate;
  Rows covariance;
  int evaluations = 0;
};

Answer fit(bool is_hexapod, int n, int p, int width, const std::vector<double>& scale,
           const std::vector<double>& start, const std::vector<double>& rows) {
  Answer answer;
  answer.estimate = start;
  ceres::Problem problem;
  for (int i = 0; i < n; ++i) {
    const double* row = rows.data() + static_cast<std::ptrdiff_t>(i) * width;
    ceres::CostFunction* cost;
    if (is_hexapod) {
      cost = new HexapodPose(row, Eigen::Matrix3d::Identity(), Eigen::Vector3d(0, 0, 0.2));
    } else {
      cost = new ceres::AutoDiffCostFunction<DeltaPosition, 3, 9>(new DeltaPosition(row));
    }
    problem.AddResidualBlock(cost, nullptr, answer.estimate.data());
  }
  ceres::Solver::Options options;
  options.linear_solver_type = ceres::DENSE_QR;
  options.initial_trust_region_radius = 1e16;
  options.max_trust_region_radius = 1e32;
  options.function_tolerance = 1e-9;
  options.num_threads = 1;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  if (summary.termination_type != ceres::CONVERGENCE) {
    std::fprintf(stderr, "Ceres did not converge\n");
    std::exit(1);
  }
  answer.evaluations = summary.num_successful_steps + summary.num_unsuccessful_steps;
  // The covariance from the triangular factor of the rows, in columns scaled by tolerance; one more
  // step from this factor, since Ceres takes none whose gain is lost in the rounding of its cost.
  ceres::CRSMatrix jacobian;
  std::vector<double> residuals;
  problem.Evaluate(ceres::Problem::EvaluateOptions(), nullptr, &residuals, nullptr, &jacobian);
  const Eigen::Map<const Eigen::VectorXd> unit(scale.data(), p);
  const Eigen::Map<const Eigen::VectorXd> r(residuals.data(), jacobian.num_rows);
  Eigen::Map<Eigen::VectorXd> estimate(answer.estimate.data(), p);
  const Eigen::Map<const Rows> J(jacobian.values.data(), jacobian.num_rows, p);
  const Eigen::HouseholderQR<Eigen::MatrixXd> qr{Eigen::MatrixXd(J * unit.asDiagonal())};
  const auto R = qr.matrixQR().topRows(p).triangularView<Eigen::Upper>();
  const Eigen::VectorXd projected = qr.householderQ().adjoint() * r;
  estimate -= unit.cwiseProduct(R.solve(projected.head(p)));
  const Eigen::MatrixXd root = unit.asDiagonal() * R.solve(Eigen::MatrixXd::Identity(p, p));
  answer.covariance = root * root.transpose();
  return answer;
}

std::vector<double> read(std::ifstream& file, int count) {
  std::vector<double> values(static_cast<std::size_t>(count));
  for (double& value : values) file >> value;
  return values;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 4) return 2;
  const bool is_hexapod = std::string(argv[1]) == "hexapod";
  std::ifstream file(argv[2]);
  const int repeats = std::atoi(argv[3]), width = is_hexapod ? 18 : 9;
  int n = 0, p = 0;
  file >> n >> p;
  const std::vector<double> scale = read(file, p), start = read(file, p), rows = read(file, n * width);
  if (!file) return 2;
  Answer answer = fit(is_hexapod, n, p, width, scale, start, rows);
  std::printf("version %s\nevaluations %d\nestimate", CERES_VERSION_STRING, answer.evaluations);
  for (double value : answer.estimate) std::printf(" %.17g", value);
  std::printf("\ncovariance");
  for (int i = 0; i < p * p; ++i) std::printf(" %.17g", answer.covariance.data()[i]);
  std::printf("\nseconds");
  for (int i = 0; i < repeats; ++i) {
    const double begin = processor_time();
    answer = fit(is_hexapod, n, p, width, scale, start, rows);
    std::printf(" %.9f", processor_time() - begin);
  }
  std::printf("\n");
  return 0;
}
