/* Dense factorisations of OpenBLAS' LAPACK, called through their Fortran symbols.
 *
 * LAPACK stores columns, we store rows: what it sees in our array is A'. So A x = b is solved with
 * trans = 'T' after factoring A', and our lower triangle is its upper one.
 *
 * OpenBLAS' serial build hands its work buffers out without a lock: two threads inside it at once may
 * get the same one, and wrong numbers. So one thread at a time is let in. */
#include "kinegrad/dense.h"

#include <math.h>
#include <pthread.h>

/* Each CHARACTER argument has a hidden length at the end of the list (gfortran's convention). */
extern void dgetrf_(const int *m, const int *n, double *a, const int *lda, int *ipiv, int *info);
extern void dgetrs_(const char *trans, const int *n, const int *nrhs, const double *a,
                    const int *lda, const int *ipiv, double *b, const int *ldb, int *info,
                    size_t trans_length);
extern void dpotrf_(const char *uplo, const int *n, double *a, const int *lda, int *info,
                    size_t uplo_length);
extern void dpotrs_(const char *uplo, const int *n, const int *nrhs, const double *a,
                    const int *lda, double *b, const int *ldb, int *info, size_t uplo_length);
extern void dpbsv_(const char *uplo, const int *n, const int *kd, const int *nrhs, double *ab,
                   const int *ldab, double *b, const int *ldb, int *info, size_t uplo_length);

static pthread_mutex_t inside = PTHREAD_MUTEX_INITIALIZER;

static void enter(void)
{
  (void)pthread_mutex_lock(&inside);
}

static void leave(void)
{
  (void)pthread_mutex_unlock(&inside);
}

/* LAPACK lets NaN pass through a factorisation: the diagonal tells */
static bool usable_diagonal(const double *A, int n)
{
  for (int i = 0; i < n; i++) {
    const double d = A[(size_t)i * (size_t)n + (size_t)i];
    if (!isfinite(d) || d == 0.0) return false;
  }
  return true;
}

bool kg_dense_lu_factor(double *A, int *pivots, int n)
{
  KG_ASSERT(A && pivots && n >= 1);
  int info = 0;
  enter();
  dgetrf_(&n, &n, A, &n, pivots, &info);
  leave();
  KG_ASSERT(info >= 0);
  return info == 0 && usable_diagonal(A, n);
}

static void lu_solve(const char *trans, const double *LU, const int *pivots, int n, double *b,
                     int count)
{
  KG_ASSERT(LU && pivots && b && n >= 1 && count >= 0);
  int info = 0;
  enter();
  dgetrs_(trans, &n, &count, LU, &n, pivots, b, &n, &info, 1);
  leave();
  KG_ASSERT(info == 0);
}

void kg_dense_lu_solve(const double *LU, const int *pivots, int n, double *b, int count)
{
  lu_solve("T", LU, pivots, n, b, count);
}

void kg_dense_lu_solve_transposed(const double *LU, const int *pivots, int n, double *b, int count)
{
  lu_solve("N", LU, pivots, n, b, count);
}

bool kg_dense_cholesky_factor(double *A, int n)
{
  KG_ASSERT(A && n >= 1);
  int info = 0;
  enter();
  dpotrf_("U", &n, A, &n, &info, 1);
  leave();
  KG_ASSERT(info >= 0);
  return info == 0 && usable_diagonal(A, n);
}

void kg_dense_cholesky_solve(const double *L, int n, double *b, int count)
{
  KG_ASSERT(L && b && n >= 1 && count >= 0);
  int info = 0;
  enter();
  dpotrs_("U", &n, &count, L, &n, b, &n, &info, 1);
  leave();
  KG_ASSERT(info == 0);
}

bool kg_band_cholesky_solve(double *band, int n, int below, double *b)
{
  KG_ASSERT(band && b && n >= 1 && below >= 0);
  const int one = 1, rows = below + 1;
  int info = 0;
  enter();
  dpbsv_("L", &n, &below, &one, band, &rows, b, &n, &info, 1);
  leave();
  KG_ASSERT(info >= 0);
  if (info != 0) return false;
  for (int j = 0; j < n; j++) { /* as above: NaN passes through LAPACK */
    if (!isfinite(b[j])) return false;
  }
  return true;
}
