#pragma once

#include <cmath>
#include <utility>

#include "common/geometry/pose.h"

namespace bodyschema {

/// ŝ = (0, 0, slide, 0, 0, turn): a motion along and about the z axis of its frame. Revolute:
/// slide = 0. Prismatic: turn = 0. Helical: both.
struct Screw {
  double slide = 0;  ///< [m per unit of the displacement]
  double turn = 0;   ///< [rad per unit of the displacement]

  /// X ← X · Exp(ŝ q), X = (R, p): z stays, x and y turn about it.
  template <class Rotation, class Translation>
  void append_motion(double q, Rotation&& R, Translation&& p) const {
    const double c = std::cos(turn * q), s = std::sin(turn * q);
    p += slide * q * R.col(2);
    const Eigen::Vector3d x = R.col(0);
    R.col(0) = c * x + s * R.col(1);
    R.col(1) = c * R.col(1) - s * x;
  }
  /// X ← Exp(ŝ q) · X.
  template <class Rotation, class Translation>
  void prepend_motion(double q, Rotation&& R, Translation&& p) const {
    const double c = std::cos(turn * q), s = std::sin(turn * q);
    const Eigen::RowVector3d x = R.row(0);
    R.row(0) = c * x - s * R.row(1);
    R.row(1) = s * x + c * R.row(1);
    p = Eigen::Vector3d(c * p.x() - s * p.y(), s * p.x() + c * p.y(), p.z() + slide * q);
  }
  /// Ad(X⁻¹) of the screws (0, 0, 1, 0, 0, 0) and (0, 0, 0, 0, 0, 1): ŝ at the end of X = (R, p).
  template <class Rotation, class Translation>
  static Eigen::Matrix<double, 6, 2> twists_after(const Rotation& R, const Translation& p) {
    Eigen::Matrix<double, 6, 2> twists;
    const Eigen::Vector3d z = R.row(2).transpose();
    twists.col(0) << z, Eigen::Vector3d::Zero();
    twists.col(1) << lever(R, p), z;
    return twists;
  }
  /// The velocity at the end of X of a turn about z.
  template <class Rotation, class Translation>
  static Eigen::Vector3d lever(const Rotation& R, const Translation& p) {
    return p.x() * R.row(1).transpose() - p.y() * R.row(0).transpose();
  }
  /// column += rate · Ad(X⁻¹) ŝ.
  template <class Rotation, class Translation, class Column>
  void add_twist_after(const Rotation& R, const Translation& p, double rate,
                       Column&& column) const {
    const Eigen::Vector3d z = R.row(2).transpose();
    column.template head<3>() += rate * (slide * z + turn * lever(R, p));
    column.template tail<3>() += rate * turn * z;
  }
};

/// Places of a chain's parameters in its Jacobians and covariances: the tangent of A_d (6, right
/// perturbation), then slide and turn of screw d, then the tangent of A_(d+1).
struct ScrewChainLayout {
  static constexpr int size(int num_screws) { return 8 * num_screws + 6; }
  static constexpr int transform(int d) { return 8 * d; }
  static constexpr int slide(int d) { return 8 * d + 6; }
  static constexpr int turn(int d) { return 8 * d + 7; }
  /// The d of a place; of the last transform the number of screws.
  static constexpr int screw_of(int place) { return place / 8; }
  /// Whether a place is a screw's, not a transform's.
  static constexpr bool is_screw(int place) { return place % 8 >= 6; }
};

/// One screw of a chain at its displacement q, and the transform that follows: Exp(ŝ q) · A.
struct ScrewLink {
  Screw screw;
  double q = 0;
  const Pose& X_after;
};

/// A chain of screws at one action, Δ = A_0 ∏_d Exp(ŝ_d q_d) A_(d+1), over whatever stores it:
/// `link_at(d)` is the ScrewLink d. All derivatives are right perturbations at the chain's end.
template <class LinkAt>
class ScrewChain {
 public:
  ScrewChain(const Pose& first, int num_screws, LinkAt link_at)
      : first_(first), num_screws_(num_screws), link_at_(std::move(link_at)) {}

  Pose predict() const {
    Pose X = first_;
    for (int d = 0; d < num_screws_; ++d) {
      const ScrewLink link = link_at_(d);
      link.screw.append_motion(link.q, X.linear(), X.translation());
      X = X * link.X_after;
    }
    return X;
  }

  /// Δ · suffix and its derivative by the parameters, 6 × ScrewChainLayout::size().
  template <class Jacobian>
  Pose predict_by_parameters(Jacobian* J, Pose suffix = Pose::Identity()) const {
    J->resize(6, ScrewChainLayout::size(num_screws_));
    visit_backwards(
        &suffix,
        [&](int d, const ScrewLink& link) {
          J->template middleCols<2>(ScrewChainLayout::slide(d)) =
              link.q * Screw::twists_after(suffix.linear(), suffix.translation());
        },
        [&](int d) {
          J->template middleCols<6>(ScrewChainLayout::transform(d)) = adjoint(suffix.inverse());
        });
    return first_ * suffix;
  }

  /// Δ · suffix and its derivative by the displacements q_d, 6 × the number of screws.
  template <class Jacobian>
  Pose predict_by_displacements(Jacobian* J, Pose suffix = Pose::Identity()) const {
    J->setZero(6, num_screws_);
    visit_backwards(
        &suffix,
        [&](int d, const ScrewLink& link) {
          link.screw.add_twist_after(suffix.linear(), suffix.translation(), 1, J->col(d));
        },
        [](int) {});
    return first_ * suffix;
  }

 private:
  // From the end to the start: `at_transform(d)` with what follows A_d in the suffix, `at_screw(d)`
  // with what follows the screw's own motion, which commutes with ŝ.
  template <class AtScrew, class AtTransform>
  void visit_backwards(Pose* suffix, const AtScrew& at_screw,
                       const AtTransform& at_transform) const {
    for (int d = num_screws_; d-- > 0;) {
      const ScrewLink link = link_at_(d);
      at_transform(d + 1);
      *suffix = link.X_after * *suffix;
      at_screw(d, link);
      link.screw.prepend_motion(link.q, suffix->linear(), suffix->translation());
    }
    at_transform(0);
  }

  const Pose& first_;
  const int num_screws_;
  const LinkAt link_at_;
};

}  // namespace bodyschema
