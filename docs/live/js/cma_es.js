"use strict";
// CMA-ES, as pycma runs it for C (Hansen 2016, arXiv:1604.00772).
//
// CMA-ES keeps a normal distribution N(mean, sigma^2 C) over the points that it may try next. A
// generation samples points from it, ranks them by fitness, and moves the distribution towards the
// best. Only the ranks count, never the values. Fitness is minimised, as in pycma.
//
// A fixed stream of random numbers gives the same means, step sizes and covariances as pycma 4.5
// with its default options: the tests compare them. A matrix is kept row after row.
globalThis.stad ??= {};

{
  const sum = (values) => values.reduce((total, value) => total + value, 0);

  function dot(a, b) {
    let [even, odd, i] = [0, 0, 0]; // two sums, because the processor adds in parallel
    for (; i + 1 < a.length; i += 2) {
      even += a[i] * b[i];
      odd += a[i + 1] * b[i + 1];
    }
    return i < a.length ? even + odd + a[i] * b[i] : even + odd;
  }

  /** to += factor * from, in place. */
  function add(to, from, factor) {
    for (let i = 0; i < to.length; i++) to[i] += factor * from[i];
  }

  /**
   * Eigenvalues and eigenvectors of a symmetric positive definite matrix.
   *
   * Rotations make its rows orthogonal, two at a time (one-sided Jacobi, Hestenes 1958). In the
   * end they are the eigenvectors, each times its eigenvalue.
   * @param {Float64Array} matrix (n, n)
   * @returns {{values: number[], vectors: Float64Array[]}}
   */
  stad.eigen = (matrix, n) => {
    const rows = Array.from({ length: n }, (_, i) => matrix.slice(i * n, (i + 1) * n));
    let squares = [];
    for (let turned = true; turned;) {
      turned = false;
      squares = rows.map((row) => dot(row, row));
      for (let i = 1; i < n; i++)
        for (let j = 0; j < i; j++) {
          const product = dot(rows[i], rows[j]);
          if (product ** 2 <= 1e-22 * squares[i] * squares[j]) continue;
          turned = true;
          const ratio = (squares[j] - squares[i]) / (2 * product);
          const tangent = (ratio < 0 ? -1 : 1) / (Math.abs(ratio) + Math.hypot(1, ratio));
          turn(rows[i], rows[j], tangent);
          squares[i] -= tangent * product;
          squares[j] += tangent * product;
        }
    }
    const values = squares.map(Math.sqrt);
    rows.forEach((row, i) => row.forEach((value, k) => (row[k] = value / values[i])));
    return { values, vectors: rows };
  };

  /** Rotate two rows by an angle, in place. */
  function turn(a, b, tangent) {
    const cosine = 1 / Math.hypot(1, tangent);
    const sine = cosine * tangent;
    for (let k = 0; k < a.length; k++) {
      const x = a[k]; // two constants: destructuring is slow here
      const y = b[k];
      a[k] = cosine * x - sine * y;
      b[k] = sine * x + cosine * y;
    }
  }

  /** Half axes of the ellipse of a symmetric matrix [xx, xy, yy], and the longer one's angle. */
  function ellipseOf([xx, xy, yy]) {
    const [middle, radius] = [(xx + yy) / 2, Math.hypot((xx - yy) / 2, xy)];
    const large = middle + radius;
    // The product of the eigenvalues is the determinant: middle - radius would lose digits.
    const small = (xx * yy - xy * xy) / large;
    return { large, small, angle: Math.atan2(2 * xy, xx - yy) / 2 };
  }

  /** Expected length of a standard normal vector. */
  function expectedLength(n) {
    let length = n % 2 ? Math.sqrt(2 / Math.PI) : Math.sqrt(Math.PI / 2);
    for (let k = n % 2 || 2; k < n; k += 2) length *= (k + 1) / k;
    return length;
  }

  /**
   * The constants, which follow from the population size and the number of dimensions. The better
   * half of the points pull the mean; the others have negative weights, with which the covariance
   * shrinks along what failed.
   */
  function parameters(population, n) {
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
    const c1 = (Math.min(1, population / 6) * 2) / ((n + 1.3) ** 2 + mueff);
    const cmu = Math.min(1 - c1, (2 * (0.25 + mueff - 2 + 1 / mueff)) / ((n + 2) ** 2 + mueff));
    const cs = Math.min(0.5, (mueff + 2) / (n + mueff + 3));
    // Bounds on the negative weights: no decay in sum, trust as far as mueff goes, C positive.
    const least = Math.min(
      1 + c1 / cmu,
      (1 - c1 - cmu) / cmu / n,
      1 + (2 * effective(worse)) / (mueff + 2),
    );
    return {
      weights: [...better, ...worse.map((w) => w * least)],
      better: better.length,
      mueff,
      c1,
      cmu,
      cs,
      cc: (4 + mueff / n) / (n + 4 + (2 * mueff) / n),
      damping: 1 + 2 * Math.max(0, Math.sqrt((mueff - 1) / (n + 1)) - 1) + cs,
      chi: expectedLength(n),
      patience: 1 / (c1 + cmu) / n / 10, // generations between two decompositions of C
    };
  }

  stad.CMAES = class {
    /**
     * @param {ArrayLike<number>} mean where to begin
     * @param {number} sigma initial step size
     * @param {number} population points in a generation, at least 4
     */
    constructor(mean, sigma, population) {
      const n = mean.length;
      [this.n, this.mean, this.sigma, this.population] = [n, [...mean], sigma, population];
      this.covariance = new Float64Array(n * n);
      for (let i = 0; i < n; i++) this.covariance[i * n + i] = 1;
      this.axes = { values: Array(n).fill(1), vectors: null }; // C is round: no vectors needed
      this.pathSigma = new Float64Array(n); // of the mean, where the distribution is round
      this.pathC = new Float64Array(n); // of the mean, in units of sigma
      this.generation = this.decomposed = 0;
      this.constants = parameters(population, n);
    }

    /** The symmetric matrix with C's axes, and f of each eigenvalue, times a vector. */
    times(f, vector) {
      const { values, vectors } = this.axes;
      if (!vectors) return Float64Array.from(vector, (value) => f(1) * value);
      const product = new Float64Array(this.n);
      values.forEach((value, i) => add(product, vectors[i], f(value) * dot(vectors[i], vector)));
      return product;
    }

    /**
     * Sample a generation.
     * @param {ArrayLike<number>[]} normals standard normal numbers for each point, (population, n)
     * @returns {Float64Array[]} the points
     */
    ask(normals) {
      const { patience } = this.constants;
      if (this.generation > this.decomposed && this.generation >= this.decomposed + patience) {
        this.axes = stad.eigen(this.covariance, this.n);
        this.decomposed = this.generation;
      }
      return normals.map((normal) => {
        const step = this.times(Math.sqrt, normal);
        return step.map((value, k) => this.mean[k] + this.sigma * value);
      });
    }

    /**
     * Move the distribution.
     * @param {ArrayLike<number>[]} points from `ask`
     * @param {number[]} fitness of each, to be minimised
     */
    tell(points, fitness) {
      const { better, mueff, cs, cc, damping, chi, weights } = this.constants;
      const { n, sigma } = this;
      this.generation += 1;
      const order = points.map((_, i) => i).sort((a, b) => fitness[a] - fitness[b]);
      const steps = order.map((i) =>
        Float64Array.from(points[i], (value, k) => (value - this.mean[k]) / sigma),
      );

      // 1. The mean moves to the weighted average of the better points.
      const moved = new Float64Array(n);
      for (let i = 0; i < better; i++) add(moved, steps[i], weights[i]);
      this.mean = this.mean.map((value, k) => value + sigma * moved[k]);

      // 2. Two paths remember where the mean has been going.
      const inverse = (value) => 1 / Math.sqrt(value);
      const gain = Math.sqrt(cs * (2 - cs) * mueff);
      const round = this.times(inverse, moved);
      this.pathSigma = this.pathSigma.map((p, k) => (1 - cs) * p + gain * round[k]);
      // While the path is very long, sigma is far too small, and C had better not stretch for it.
      const squared = dot(this.pathSigma, this.pathSigma);
      const corrected = squared / (1 - (1 - cs) ** (2 * this.generation));
      const hsig = corrected / n < 2 + 4 / (n + 1) ? 1 : 0;
      const pull = hsig * Math.sqrt(cc * (2 - cc) * mueff);
      this.pathC = this.pathC.map((p, k) => (1 - cc) * p + pull * moved[k]);

      // 3. The covariance learns the path (rank one) and the points (rank mu).
      this.learn(steps, hsig, inverse);

      // 4. A path longer than a random walk's asks for longer steps, a shorter one for shorter.
      const change = ((Math.sqrt(squared) / chi - 1) * cs) / damping;
      this.sigma *= Math.exp(Math.min(1, Math.max(-1, change)));
    }

    /** C's update by the steps, the best first. */
    learn(steps, hsig, inverse) {
      const { weights, c1, cmu, cc } = this.constants;
      const { n, covariance } = this;
      const rates = weights.map((w, i) => {
        if (w >= 0) return cmu * w;
        const length = Math.hypot(...this.times(inverse, steps[i]));
        return (cmu * w * n) / (length + 1e-9) ** 2;
      });
      const kept = 1 - c1 * (1 - (1 - hsig) * cc * (2 - cc)) - cmu * sum(weights);
      for (let i = 0; i < n; i++) {
        const row = covariance.subarray(i * n, (i + 1) * n);
        for (let k = 0; k < n; k++) row[k] *= kept;
        add(row, this.pathC, c1 * this.pathC[i]);
        steps.forEach((step, s) => add(row, step, rates[s] * step[i]));
      }
    }

    /** The ellipse of one standard deviation in two coordinates: half axes, longer one's angle. */
    ellipse(i = 0, j = 1) {
      const at = (row, column) => this.covariance[row * this.n + column];
      const { large, small, angle } = ellipseOf([at(i, i), at(i, j), at(j, j)]);
      return { long: this.sigma * Math.sqrt(large), short: this.sigma * Math.sqrt(small), angle };
    }
  };

  /** Functions of (x, y) to minimise, each with its best points and the part to show. */
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
