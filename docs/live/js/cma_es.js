"use strict";
// CMA-ES in two dimensions, as pycma runs it for C in 867 (Hansen 2016, arXiv:1604.00772).
//
// CMA-ES keeps a normal distribution N(mean, sigma^2 C) over the points that it may try next. A
// generation samples points from it, ranks them by fitness, and moves the distribution towards the
// best. Only the ranks count, never the values. Fitness is minimised, as in pycma.
//
// A fixed stream of random numbers gives the same means, step sizes and covariances as pycma 4.5
// with its default options: the tests compare them. A symmetric matrix is kept as [xx, xy, yy].
globalThis.stad ??= {};

{
  const N = 2;
  /** Expected length of a standard normal vector in two dimensions. */
  const CHI_N = Math.sqrt(Math.PI / 2);

  const sum = (values) => values.reduce((total, value) => total + value, 0);
  const squared = (v) => v[0] * v[0] + v[1] * v[1];
  /** A symmetric matrix times a vector. */
  const times = (m, v) => [m[0] * v[0] + m[1] * v[1], m[1] * v[0] + m[2] * v[1]];

  /**
   * Eigenvalues and the direction of the longer axis of a symmetric matrix.
   * @param {number[]} m [xx, xy, yy]
   * @returns {{large: number, small: number, angle: number}} angle of the longer axis, radians
   */
  function axes([xx, xy, yy]) {
    const middle = (xx + yy) / 2;
    const radius = Math.hypot((xx - yy) / 2, xy);
    const large = middle + radius;
    // The product of the eigenvalues is the determinant: middle - radius would lose digits.
    const small = (xx * yy - xy * xy) / large;
    return { large, small, angle: Math.atan2(2 * xy, xx - yy) / 2 };
  }

  /** The symmetric matrix with the same axes, and f of each eigenvalue. */
  function withEigenvalues(m, f) {
    const { large, small, angle } = axes(m);
    const [a, b, c, s] = [f(large), f(small), Math.cos(angle), Math.sin(angle)];
    return [a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c];
  }

  /**
   * The constants, which follow from the population size alone. The better half of the points pull
   * the mean; the others have negative weights, with which the covariance shrinks along what failed.
   */
  function parameters(population) {
    const raw = Array.from(
      { length: population },
      (_, i) => Math.log((population + 1) / 2) - Math.log(i + 1),
    );
    const positive = sum(raw.filter((w) => w > 0));
    const negative = -sum(raw.filter((w) => w < 0));
    const better = raw.filter((w) => w > 0).map((w) => w / positive);
    const worse = raw.filter((w) => w <= 0).map((w) => w / negative);
    const effective = (w) => sum(w) ** 2 / sum(w.map((one) => one * one));
    const mueff = effective(better); // how many points the mean effectively averages
    const c1 = (Math.min(1, population / 6) * 2) / ((N + 1.3) ** 2 + mueff);
    const cmu = Math.min(1 - c1, (2 * (0.25 + mueff - 2 + 1 / mueff)) / ((N + 2) ** 2 + mueff));
    const cs = Math.min(0.5, (mueff + 2) / (N + mueff + 3));
    // Bounds on the negative weights: no decay in sum, trust as far as mueff goes, C stays positive.
    const least = Math.min(
      1 + c1 / cmu,
      (1 - c1 - cmu) / cmu / N,
      1 + (2 * effective(worse)) / (mueff + 2),
    );
    return {
      weights: [...better, ...worse.map((w) => w * least)],
      better: better.length,
      mueff,
      c1,
      cmu,
      cs,
      cc: (4 + mueff / N) / (N + 4 + (2 * mueff) / N),
      damping: 1 + 2 * Math.max(0, Math.sqrt((mueff - 1) / (N + 1)) - 1) + cs,
    };
  }

  stad.CMAES = class {
    /**
     * @param {number[]} mean where to begin
     * @param {number} sigma initial step size
     * @param {number} population points in a generation, at least 4
     */
    constructor(mean, sigma, population) {
      this.mean = [...mean];
      this.sigma = sigma;
      this.population = population;
      this.covariance = [1, 0, 1];
      this.pathSigma = [0, 0]; // of the mean, in units in which the distribution is round
      this.pathC = [0, 0]; // of the mean, in units of sigma
      this.generation = 0;
      this.constants = parameters(population);
    }

    /**
     * Sample a generation.
     * @param {number[][]} normals a standard normal pair for each point
     * @returns {number[][]} the points
     */
    ask(normals) {
      const root = withEigenvalues(this.covariance, Math.sqrt);
      return normals.map((normal) => {
        const step = times(root, normal);
        return [this.mean[0] + this.sigma * step[0], this.mean[1] + this.sigma * step[1]];
      });
    }

    /**
     * Move the distribution.
     * @param {number[][]} points from `ask`
     * @param {number[]} fitness of each, to be minimised
     */
    tell(points, fitness) {
      const { weights, better, mueff, c1, cmu, cs, cc, damping } = this.constants;
      this.generation += 1;
      const order = points.map((_, i) => i).sort((a, b) => fitness[a] - fitness[b]);
      const [x, y] = this.mean;
      const steps = order.map((i) => [
        (points[i][0] - x) / this.sigma,
        (points[i][1] - y) / this.sigma,
      ]);

      // 1. The mean moves to the weighted average of the better points.
      const moved = [0, 1].map((k) => sum(steps.slice(0, better).map((s, i) => weights[i] * s[k])));
      this.mean = [x + this.sigma * moved[0], y + this.sigma * moved[1]];

      // 2. Two paths remember where the mean has been going.
      const whiten = withEigenvalues(this.covariance, (value) => 1 / Math.sqrt(value));
      const round = times(whiten, moved);
      const gain = Math.sqrt(cs * (2 - cs) * mueff);
      this.pathSigma = this.pathSigma.map((p, k) => (1 - cs) * p + gain * round[k]);
      // While the path is very long, sigma is far too small, and C had better not stretch for it.
      const corrected = squared(this.pathSigma) / (1 - (1 - cs) ** (2 * this.generation));
      const hsig = corrected / N < 2 + 4 / (N + 1) ? 1 : 0;
      const pull = hsig * Math.sqrt(cc * (2 - cc) * mueff);
      this.pathC = this.pathC.map((p, k) => (1 - cc) * p + pull * moved[k]);

      // 3. The covariance learns the path (rank one) and the points (rank mu).
      const rates = weights.map((w, i) =>
        w < 0 ? (cmu * w * N) / (Math.sqrt(squared(times(whiten, steps[i]))) + 1e-9) ** 2 : cmu * w,
      );
      const kept = 1 - c1 * (1 - (1 - hsig) * cc * (2 - cc)) - cmu * sum(weights);
      const product = (j, k) =>
        c1 * this.pathC[j] * this.pathC[k] + sum(steps.map((s, i) => rates[i] * s[j] * s[k]));
      this.covariance = this.covariance.map(
        (value, i) =>
          kept * value +
          product(
            ...[
              [0, 0],
              [0, 1],
              [1, 1],
            ][i],
          ),
      );

      // 4. A path longer than a random walk's asks for longer steps, a shorter one for shorter.
      const length = Math.sqrt(squared(this.pathSigma));
      const change = ((length / CHI_N - 1) * cs) / damping;
      this.sigma *= Math.exp(Math.min(1, Math.max(-1, change)));
    }

    /** The ellipse of one standard deviation: half axes, and the angle of the longer one. */
    ellipse() {
      const { large, small, angle } = axes(this.covariance);
      return { long: this.sigma * Math.sqrt(large), short: this.sigma * Math.sqrt(small), angle };
    }
  };

  /** Functions of (x, y) to minimise, each with its best points and the part of the plane to show. */
  stad.landscapes = {
    sphere: { name: "Sphere", f: (x, y) => x * x + y * y, minima: [[0, 0]], reach: 4 },
    ellipse: {
      name: "Ellipse (turned)",
      // One hundred times steeper along one diagonal than along the other.
      f: (x, y) => ((x + y) ** 2 + 100 * (x - y) ** 2) / 2,
      minima: [[0, 0]],
      reach: 4,
    },
    rosenbrock: {
      name: "Rosenbrock (bent valley)",
      f: (x, y) => (1 - x) ** 2 + 100 * (y - x * x) ** 2,
      minima: [[1, 1]],
      reach: 2.5,
    },
    rastrigin: {
      name: "Rastrigin (many minima)",
      f: (x, y) =>
        20 + x * x - 10 * Math.cos(2 * Math.PI * x) + y * y - 10 * Math.cos(2 * Math.PI * y),
      minima: [[0, 0]],
      reach: 4,
    },
    himmelblau: {
      name: "Himmelblau (four minima)",
      f: (x, y) => (x * x + y - 11) ** 2 + (x + y * y - 7) ** 2,
      minima: [
        [3, 2],
        [-2.805118, 3.131312],
        [-3.77931, -3.283186],
        [3.584428, -1.848126],
      ],
      reach: 5,
    },
  };
}
