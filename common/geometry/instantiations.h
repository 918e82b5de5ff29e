#pragma once

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <Eigen/SVD>

/// What of Eigen recurs, compiled once, in instantiations.cpp: a source that compiles an
/// eigensolver of its own takes 8 s longer, a Cholesky factor 1 to 2 s. Whoever hands over an
/// expression instead of a matrix compiles his own.
#define BODYSCHEMA_INSTANTIATIONS(EXTERN)                                                      \
  EXTERN template SelfAdjointEigenSolver<Matrix3d>& SelfAdjointEigenSolver<Matrix3d>::compute( \
      const EigenBase<Matrix3d>&, int);                                                        \
  EXTERN template SelfAdjointEigenSolver<Matrix6d>& SelfAdjointEigenSolver<Matrix6d>::compute( \
      const EigenBase<Matrix6d>&, int);                                                        \
  EXTERN template SelfAdjointEigenSolver<Matrix8d>& SelfAdjointEigenSolver<Matrix8d>::compute( \
      const EigenBase<Matrix8d>&, int);                                                        \
  EXTERN template SelfAdjointEigenSolver<MatrixXd>& SelfAdjointEigenSolver<MatrixXd>::compute( \
      const EigenBase<MatrixXd>&, int);                                                        \
  EXTERN template LLT<Matrix6d>& LLT<Matrix6d>::compute(const EigenBase<Matrix6d>&);           \
  EXTERN template LLT<MatrixXd>& LLT<MatrixXd>::compute(const EigenBase<MatrixXd>&);           \
  EXTERN template LDLT<Matrix6d>& LDLT<Matrix6d>::compute(const EigenBase<Matrix6d>&);         \
  EXTERN template LDLT<MatrixXd>& LDLT<MatrixXd>::compute(const EigenBase<MatrixXd>&);         \
  EXTERN template JacobiSVD<Matrix3d>& JacobiSVD<Matrix3d>::compute(const Matrix3d&, unsigned);

namespace Eigen {

using Matrix6d = Matrix<double, 6, 6>;
using Matrix8d = Matrix<double, 8, 8>;

BODYSCHEMA_INSTANTIATIONS(extern)

}  // namespace Eigen
