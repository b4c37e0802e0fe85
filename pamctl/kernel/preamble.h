/* What Python does, in C. Where Python would raise, `failed` is set, and the caller asks Python.

   The same bits: no fused operations, and the C library's own functions as Python calls them. The
   compiler must not evaluate these functions itself (-fno-builtin): it would round otherwise. */

#include <math.h>

typedef struct { double *at; long long length; } Numbers;
typedef struct { long long *at; long long length; } Integers;
typedef struct { double *at; long long rows, columns; } Grid;
typedef struct { char *at; long long length, stride; } Rows;

#if defined(__GNUC__)
#define UNUSED __attribute__((unused))
#if defined(__GLIBC__) /* at a fixed distance: each access would call a function otherwise */
#define ITS_THREADS_OWN __thread __attribute__((tls_model("initial-exec")))
#else
#define ITS_THREADS_OWN __thread
#endif
#define ADD(a, b, sum) __builtin_saddll_overflow(a, b, sum)
#define SUBTRACT(a, b, rest) __builtin_ssubll_overflow(a, b, rest)
#define MULTIPLY(a, b, product) __builtin_smulll_overflow(a, b, product)
#define ROOT(x) __builtin_sqrt(x)
#define MAGNITUDE(x) __builtin_fabs(x)
#else
#define UNUSED
#define ADD(a, b, sum) (*(sum) = (a) + (b), 0)
#define SUBTRACT(a, b, rest) (*(rest) = (a) - (b), 0)
#define MULTIPLY(a, b, product) (*(product) = (a) * (b), 0)
#define ROOT(x) sqrt(x)
#define MAGNITUDE(x) fabs(x)
#if defined(_MSC_VER)
#define ITS_THREADS_OWN __declspec(thread)
#else
#define ITS_THREADS_OWN
#endif
#endif
static ITS_THREADS_OWN int failed UNUSED;

/* Integers of Python have no end; those of C have 64 bits. What fails is 0: no loop is longer. */
UNUSED static long long added(long long a, long long b) {
    long long sum;
    if (ADD(a, b, &sum)) failed = 1, sum = 0;
    return sum;
}
UNUSED static long long subtracted(long long a, long long b) {
    long long rest;
    if (SUBTRACT(a, b, &rest)) failed = 1, rest = 0;
    return rest;
}
UNUSED static long long multiplied(long long a, long long b) {
    long long product;
    if (MULTIPLY(a, b, &product)) failed = 1, product = 0;
    return product;
}
UNUSED static long long floor_divided_int(long long a, long long b) {
    if (b == 0 || b == -1) {
        if (b == 0) failed = 1;
        return b == 0 ? 0 : subtracted(0, a);
    }
    long long whole = a / b;
    return whole - (a % b != 0 && (a < 0) != (b < 0));
}
UNUSED static long long remainder_int(long long a, long long b) {
    if (b == 0 || b == -1) {
        if (b == 0) failed = 1;
        return 0;
    }
    long long rest = a % b;
    return rest + (rest != 0 && (rest < 0) != (b < 0) ? b : 0);
}
UNUSED static long long shifted_left(long long a, long long by) {
    if (by < 0 || by > 62 || a > (0x7fffffffffffffffLL >> by) || a < -(0x7fffffffffffffffLL >> by)) {
        failed = 1;
        return 0;
    }
    return a * (1LL << by);
}
UNUSED static long long shifted_right(long long a, long long by) {
    if (by < 0) failed = 1;
    return by < 0 ? 0 : by > 62 ? (a < 0 ? -1 : 0) : a >> by;
}
UNUSED static long long magnitude_int(long long a) { return a < 0 ? subtracted(0, a) : a; }
UNUSED static long long larger_int(long long a, long long b) { return b > a ? b : a; }
UNUSED static long long smaller_int(long long a, long long b) { return b < a ? b : a; }

/* An int as it stands, where a float that is rounded would not do. */
UNUSED static double exact(long long a) {
    if (a > 9007199254740992LL || a < -9007199254740992LL) failed = 1;
    return (double)a;
}

/* The first argument wins unless the second is truly larger, or smaller. */
UNUSED static double larger(double a, double b) { return b > a ? b : a; }
UNUSED static double smaller(double a, double b) { return b < a ? b : a; }

UNUSED static double divided(double a, double b) {
    if (b == 0.0) failed = 1;
    return a / b;
}
UNUSED static double remainder_of(double a, double b) {
    if (b == 0.0) failed = 1;
    double rest = fmod(a, b);
    if (rest == 0.0) return copysign(0.0, b);
    return (b < 0.0) != (rest < 0.0) ? rest + b : rest;
}
UNUSED static double floor_divided(double a, double b) {
    if (b == 0.0) failed = 1;
    double rest = fmod(a, b), whole = (a - rest) / b;
    if (rest != 0.0 && (b < 0.0) != (rest < 0.0)) whole -= 1.0;
    if (whole == 0.0) return copysign(0.0, a / b);
    double down = floor(whole);
    return whole - down > 0.5 ? down + 1.0 : down;
}

/* A result that is no number of numbers, or infinite of finite ones, is an error in Python. */
UNUSED static double checked(double result, double of) {
    if (!isfinite(result) && (isnan(result) ? !isnan(of) : isfinite(of))) failed = 1;
    return result;
}
#define CHECKED(function) \
    UNUSED static double checked_##function(double x) { return checked(function(x), x); }
CHECKED(exp) CHECKED(expm1) CHECKED(log) CHECKED(log2) CHECKED(log10) CHECKED(log1p) CHECKED(sin)
CHECKED(cos) CHECKED(tan) CHECKED(asin) CHECKED(acos) CHECKED(atan) CHECKED(sinh) CHECKED(cosh)
CHECKED(tanh)
UNUSED static double raised(double base, double power) {
    double result = pow(base, power);
    if (!isfinite(result) && isfinite(base) && isfinite(power)) failed = 1;
    if (base < 0.0 && isfinite(base) && isfinite(power) && power != floor(power)) failed = 1;
    return result;
}
UNUSED static double root(double x) { return checked(ROOT(x), x); }
UNUSED static long long to_int(double x) {
    if (!(x > -9.2e18 && x < 9.2e18)) {
        failed = 1;
        return 0;
    }
    return (long long)x;
}

/* An index outside an array is an error; one from the end is not. */
UNUSED static long long place(long long index, long long length) {
    if (index < 0) index += length;
    if (index < 0 || index >= length) {
        failed = 1;
        return -1;
    }
    return index;
}
UNUSED static double get(Numbers from, long long index) {
    index = place(index, from.length);
    return index < 0 ? NAN : from.at[index];
}
UNUSED static long long get_int(Integers from, long long index) {
    index = place(index, from.length);
    return index < 0 ? 0 : from.at[index];
}
UNUSED static double get_from(Grid from, long long row, long long column) {
    row = place(row, from.rows), column = place(column, from.columns);
    return row < 0 || column < 0 ? NAN : from.at[row * from.columns + column];
}
UNUSED static void put(Numbers into, long long index, double value) {
    index = place(index, into.length);
    if (index >= 0) into.at[index] = value;
}
UNUSED static void put_int(Integers into, long long index, long long value) {
    index = place(index, into.length);
    if (index >= 0) into.at[index] = value;
}
UNUSED static void put_into(Grid into, long long row, long long column, double value) {
    row = place(row, into.rows), column = place(column, into.columns);
    if (row >= 0 && column >= 0) into.at[row * into.columns + column] = value;
}
UNUSED static void *row_at(Rows rows, long long index) {
    if (index < 0 || index >= rows.length) {
        failed = 1;
        return 0;
    }
    return rows.at + index * rows.stride;
}
