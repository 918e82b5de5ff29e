#pragma once

#include <Eigen/Cholesky>
#include <Eigen/SparseCholesky>
#include <type_traits>

namespace bodyschema {

/// Cholesky decomposition of a symmetric positive matrix. A large one that is mostly zero is
/// decomposed as a sparse one, its last row first: a tree whose parents come before their children
/// has no fill-in then, and N parameters cost O(N) where a dense matrix costs O(N³).
template <class Matrix>
class Cholesky {
 public:
  explicit Cholesky(const Matrix& H) {
    if constexpr (kMayBeSparse) {
      const auto size = H.rows();
      if (size >= kLarge && (H.array() != 0).count() < size * size / kSparse) {
        sparse_.compute(Eigen::MatrixXd(H.reverse()).sparseView());
        is_sparse_ = true;
        return;
      }
    }
    dense_.compute(H);
  }

  bool is_positive() const {
    return (is_sparse_ ? sparse_.info() : dense_.info()) == Eigen::Success;
  }
  /// H⁻¹ b; several columns at once.
  template <class Vector>
  Vector solve(const Vector& b) const {
    if constexpr (kMayBeSparse) {
      if (is_sparse_) {
        const Vector reversed = b.colwise().reverse();
        const Vector x = sparse_.solve(reversed);
        return x.colwise().reverse();
      }
    }
    return dense_.solve(b);
  }

 private:
  static constexpr bool kMayBeSparse = std::is_same_v<Matrix, Eigen::MatrixXd>;
  // Chosen: where the two are equally fast, to a factor of two.
  static constexpr Eigen::Index kLarge = 120, kSparse = 3;

  using Sparse = Eigen::SparseMatrix<double>;
  bool is_sparse_ = false;
  Eigen::LLT<Matrix> dense_;
  Eigen::SimplicialLLT<Sparse, Eigen::Lower, Eigen::NaturalOrdering<int>> sparse_;
};

}  // namespace bodyschema
