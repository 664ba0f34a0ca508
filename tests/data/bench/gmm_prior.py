# The log posterior of a small Gaussian mixture with gamma = 0.7, m = 2, from its definition in 40
# digits: the value that test_bench_objectives.c expects.  python3 gmm_prior.py (needs mpmath)
from mpmath import exp, gamma, log, matrix, mp, mpf, nstr, pi, zeros

mp.dps = 40
D, K, n, g, m = 3, 2, 4, mpf("0.7"), 2
S = D * (D + 1) // 2
alpha = [mpf(k + 1) / 8 for k in range(K)]
mu = [[mpf((5 * k + 3 * j) % 7) / 4 - mpf(1) / 2 for j in range(D)] for k in range(K)]
icf = [[mpf((3 * k + 5 * j) % 11) / 16 - mpf(1) / 4 for j in range(S)] for k in range(K)]
x = [[mpf((7 * i + 2 * j) % 9) / 4 - 1 for j in range(D)] for i in range(n)]


def Q(k):
    A, below = zeros(D, D), iter(icf[k][D:])
    for j in range(D):
        A[j, j] = exp(icf[k][j])
    for j in range(D):
        for i in range(j + 1, D):
            A[i, j] = next(below)
    return A


def square(A):
    return sum(A[i, j] ** 2 for i in range(A.rows) for j in range(A.cols))


def logsumexp(t):
    return log(sum(exp(a) for a in t))


q = [sum(icf[k][:D]) for k in range(K)]
L = -mpf(n) * D / 2 * log(2 * pi) - n * logsumexp(alpha)
for i in range(n):
    c = [matrix([x[i][j] - mu[k][j] for j in range(D)]) for k in range(K)]
    L += logsumexp([alpha[k] + q[k] - square(Q(k) * c[k]) / 2 for k in range(K)])
L += sum(g**2 / 2 * square(Q(k)) - m * q[k] for k in range(K))
multigamma = pi ** (mpf(D * (D - 1)) / 4)
for j in range(1, D + 1):
    multigamma *= gamma(mpf(D + m + 1) / 2 + mpf(1 - j) / 2)
L -= K * ((D + m + 1) * D * (log(g) - log(2) / 2) - log(multigamma))
print(nstr(L, 20))
