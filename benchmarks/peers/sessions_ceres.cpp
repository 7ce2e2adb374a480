// SPDX-License-Identifier: Apache-2.0
// A fit with a tracker frame and targets in every session, as a user of Ceres writes it: a hexapod
// of 42 parameters with tolerances, whose pose follows from the readings. Every session has one block
// of six numbers of the frame (rotation vector, position) and three of each target. These blocks are
// eliminated first, by a Schur complement. Derivatives are analytic.
//
// Arguments: file of numbers, repeats. The file, written by benchmarks/peers/sessions.py, holds
// n, targets, sessions, sigma; 42 tolerances; 42 nominal values; the start of every session's block;
// and for every pose its session, 6 readings and the measured targets in the frame.
// The program prints the estimate, and the processor time of every repeat with the covariance [s].

#include <ceres/ceres.h>
#include <ceres/version.h>

#include <Eigen/Dense>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <memory>
#include <vector>

#include "rotations.h"

namespace {

constexpr int P = 42;

Eigen::Matrix3d left_jacobian(const Eigen::Vector3d& v) {
  const double angle = v.norm();
  const Eigen::Matrix3d K = cross(v);
  if (angle < 1e-6) return Eigen::Matrix3d::Identity() + 0.5 * K;
  const double square = angle * angle;
  return Eigen::Matrix3d::Identity() + (1.0 - std::cos(angle)) / square * K +
         (angle - std::sin(angle)) / (square * angle) * K * K;
}

struct Data {
  int n, targets, sessions;
  double sigma;
  std::vector<double> scale, nominal, setup, rows;
  int block() const { return 6 + 3 * targets; }
  int width() const { return 7 + 3 * targets; }
};

// The machine in tolerances from nominal, and the block of a session. The pose is solved from the
// readings by Newton steps from the last solution of this pose.
class MeasuredPose : public ceres::CostFunction {
 public:
  MeasuredPose(const Data& d, const double* of_pose) : data(d), row(of_pose), R(Eigen::Matrix3d::Identity()), t(0, 0, 0.2) {
    set_num_residuals(3 * data.targets);
    *mutable_parameter_block_sizes() = {P, data.block()};
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    double x[P];
    for (int i = 0; i < P; ++i) x[i] = data.nominal[i] + data.scale[i] * parameters[0][i];
    Matrix6 A;
    Vector6 gap;
    Eigen::Vector3d unit[6];
    for (int i = 0; i < 50; ++i) {
      for (int k = 0; k < 6; ++k) {
        const Eigen::Map<const Eigen::Vector3d> base(x + 7 * k), platform(x + 7 * k + 3);
        const Eigen::Vector3d arm = R * platform, leg = t + arm - base;
        const double length = leg.norm();
        unit[k] = leg / length;
        gap[k] = length - x[7 * k + 6] - row[1 + k];
        A.row(k) << arm.cross(unit[k]).transpose(), unit[k].transpose();
      }
      if (gap.cwiseAbs().maxCoeff() < 1e-14) break;
      const Vector6 step = -A.partialPivLu().solve(gap);
      R = exponential(step.head<3>()) * R;
      t += step.tail<3>();
    }
    const double* setup = parameters[1];
    const Eigen::Map<const Eigen::Vector3d> turn(setup), place(setup + 3);
    const Eigen::Matrix3d to_frame = exponential(turn).transpose() / data.sigma;
    const bool by_machine = jacobians != nullptr && jacobians[0] != nullptr;
    const bool by_setup = jacobians != nullptr && jacobians[1] != nullptr;
    Eigen::Matrix<double, 6, P> twist;  // of the platform, by the machine
    if (by_machine) {
      Eigen::Matrix<double, 6, P> E = Eigen::Matrix<double, 6, P>::Zero();
      for (int k = 0; k < 6; ++k) {
        E.block<1, 3>(k, 7 * k) = -unit[k].transpose();
        E.block<1, 3>(k, 7 * k + 3) = unit[k].transpose() * R;
        E(k, 7 * k + 6) = -1.0;
      }
      for (int i = 0; i < P; ++i) E.col(i) *= data.scale[i];
      twist = -A.partialPivLu().solve(E);
    }
    if (by_setup) std::fill(jacobians[1], jacobians[1] + 3 * data.targets * data.block(), 0.0);
    for (int j = 0; j < data.targets; ++j) {
      const Eigen::Map<const Eigen::Vector3d> target(setup + 6 + 3 * j), measured(row + 7 + 3 * j);
      const Eigen::Vector3d arm = R * target, lever = arm + t - place;
      Eigen::Map<Eigen::Vector3d>(residuals + 3 * j) = to_frame * lever - measured / data.sigma;
      if (by_machine) {
        Eigen::Map<Eigen::Matrix<double, 3, P, Eigen::RowMajor>> J(jacobians[0] + 3 * j * P);
        J.noalias() = to_frame * (twist.bottomRows<3>() - cross(arm) * twist.topRows<3>());
      }
      if (by_setup) {
        Eigen::Map<Rows> J(jacobians[1] + 3 * j * data.block(), 3, data.block());
        J.leftCols<3>() = to_frame * cross(lever) * left_jacobian(turn);
        J.middleCols<3>(3) = -to_frame;
        J.middleCols<3>(6 + 3 * j) = to_frame * R;
      }
    }
    return true;
  }

 private:
  const Data& data;
  const double* row;
  mutable Eigen::Matrix3d R;
  mutable Eigen::Vector3d t;
};

struct Tolerances {
  template <typename T>
  bool operator()(const T* z, T* residual) const {
    for (int i = 0; i < P; ++i) residual[i] = z[i];
    return true;
  }
};

double processor_time() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

// Return the deviation of the machine in tolerances; `root` becomes a factor of its information.
std::vector<double> fit(const Data& data, Eigen::MatrixXd& root) {
  std::vector<double> z(P, 0.0), setup = data.setup;
  ceres::Problem problem;
  ceres::Solver::Options options;
  options.linear_solver_ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  for (int s = 0; s < data.sessions; ++s) {
    double* block = setup.data() + s * data.block();
    problem.AddParameterBlock(block, data.block());
    options.linear_solver_ordering->AddElementToGroup(block, 0);
  }
  options.linear_solver_ordering->AddElementToGroup(z.data(), 1);
  for (int i = 0; i < data.n; ++i) {
    const double* row = data.rows.data() + static_cast<std::ptrdiff_t>(i) * data.width();
    double* block = setup.data() + static_cast<int>(row[0]) * data.block();
    problem.AddResidualBlock(new MeasuredPose(data, row), nullptr, z.data(), block);
  }
  problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Tolerances, P, P>(new Tolerances), nullptr, z.data());
  options.linear_solver_type = ceres::DENSE_SCHUR;
  options.initial_trust_region_radius = 1e16;
  options.max_trust_region_radius = 1e32;
  options.function_tolerance = 1e-12;
  options.num_threads = 1;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  if (summary.termination_type != ceres::CONVERGENCE) {
    std::fprintf(stderr, "Ceres did not converge\n");
    std::exit(1);
  }
  // the covariance of the machine, by the Schur complement of the last rows
  Eigen::MatrixXd S = Eigen::MatrixXd::Identity(P, P);
  const int b = data.block(), m = 3 * data.targets;
  std::vector<Eigen::MatrixXd> own(data.sessions, Eigen::MatrixXd::Zero(b, b)), cross_terms(data.sessions, Eigen::MatrixXd::Zero(b, P));
  Rows by_machine(m, P), by_setup(m, b);
  std::vector<double> residual(m);
  std::vector<ceres::ResidualBlockId> blocks;
  problem.GetResidualBlocks(&blocks);
  for (int i = 0; i < data.n; ++i) {
    double* jacobians[2] = {by_machine.data(), by_setup.data()};
    const int s = static_cast<int>(data.rows[static_cast<std::size_t>(i) * data.width()]);
    const double* parameters[2] = {z.data(), setup.data() + s * b};
    problem.GetCostFunctionForResidualBlock(blocks[i])->Evaluate(parameters, residual.data(), jacobians);
    S.noalias() += by_machine.transpose() * by_machine;
    own[s].noalias() += by_setup.transpose() * by_setup;
    cross_terms[s].noalias() += by_setup.transpose() * by_machine;
  }
  for (int s = 0; s < data.sessions; ++s) S.noalias() -= cross_terms[s].transpose() * own[s].ldlt().solve(cross_terms[s]);
  root = S.llt().solve(Eigen::MatrixXd::Identity(P, P));
  return z;
}

std::vector<double> read(std::ifstream& file, int count) {
  std::vector<double> values(static_cast<std::size_t>(count));
  for (double& value : values) file >> value;
  return values;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 3) return 2;
  std::ifstream file(argv[1]);
  Data data;
  file >> data.n >> data.targets >> data.sessions >> data.sigma;
  data.scale = read(file, P);
  data.nominal = read(file, P);
  data.setup = read(file, data.sessions * data.block());
  data.rows = read(file, data.n * data.width());
  if (!file) return 2;
  Eigen::MatrixXd covariance;
  std::vector<double> z = fit(data, covariance);
  std::printf("version %s\nestimate", CERES_VERSION_STRING);
  for (double value : z) std::printf(" %.17g", value);
  std::printf("\nsd");
  for (int i = 0; i < P; ++i) std::printf(" %.17g", std::sqrt(covariance(i, i)));
  std::printf("\nseconds");
  for (int i = 0; i < std::atoi(argv[2]); ++i) {
    const double begin = processor_time();
    fit(data, covariance);
    std::printf(" %.9f", processor_time() - begin);
  }
  std::printf("\n");
  return 0;
}
