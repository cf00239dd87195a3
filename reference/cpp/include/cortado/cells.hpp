// Points sorted into cells, to find those near a place. Along a periodic axis the cells go round.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

namespace cortado {

template <int D>
class Cells {
public:
    using Point = std::array<double, D>;

    // `reach`: how far `around` looks, and the least width of a cell.
    Cells(const std::vector<Point>& points, double reach, const std::array<double, 3>& periods)
        : near_enough_((1 + 1e-9) * reach * reach) {
        Point upper{};
        for (int axis = 0; axis < D; ++axis) {
            period_[axis] = periods[axis];
            origin_[axis] = upper[axis] = points.empty() ? 0 : points[0][axis];
            for (const Point& point : points) {
                origin_[axis] = std::min(origin_[axis], point[axis]);
                upper[axis] = std::max(upper[axis], point[axis]);
            }
            const double length = period_[axis] > 0 ? period_[axis] : upper[axis] - origin_[axis] + reach;
            // Few particles far apart must not ask for many cells.
            const double most = std::ceil(4 * std::pow(double(points.size()) + 1, 1.0 / D)) + 4;
            count_[axis] = int(std::max(1.0, std::min(std::floor(length / reach), most)));
            width_[axis] = length / count_[axis];
        }
        int cells = 1;
        for (int axis = 0; axis < D; ++axis) cells *= count_[axis];
        std::vector<int> cell_of(points.size());
        first_.assign(cells + 1, 0);
        for (std::size_t i = 0; i < points.size(); ++i) {
            std::array<int, D> place = place_of(points[i]);
            for (int axis = 0; axis < D; ++axis) place[axis] = wrapped(place[axis], axis);
            ++first_[(cell_of[i] = index(place)) + 1];
        }
        for (int c = 0; c < cells; ++c) first_[c + 1] += first_[c];
        members_.resize(points.size());
        std::vector<int> next(first_.begin(), first_.end() - 1);
        for (std::size_t i = 0; i < points.size(); ++i) members_[next[cell_of[i]]++] = {int(i), points[i]};
    }

    // Every point nearer than the reach, and perhaps a few on its edge, in a fixed order, each once.
    template <class Visit>
    void around(const Point& place, const Visit& visit) const {
        const std::array<int, D> centre = place_of(place);
        std::array<int, D> lower, upper;
        for (int axis = 0; axis < D; ++axis) {
            const bool whole = period_[axis] > 0 && count_[axis] < 3;  // else a cell would be met twice
            lower[axis] = whole ? 0 : centre[axis] - 1;
            upper[axis] = whole ? count_[axis] - 1 : centre[axis] + 1;
            if (!(period_[axis] > 0)) {
                lower[axis] = std::max(lower[axis], 0);
                upper[axis] = std::min(upper[axis], count_[axis] - 1);
                if (lower[axis] > upper[axis]) return;
            }
        }
        std::array<int, D> cell = lower;
        for (;;) {
            std::array<int, D> place_in_grid;
            for (int axis = 0; axis < D; ++axis) place_in_grid[axis] = wrapped(cell[axis], axis);
            const int c = index(place_in_grid);
            for (int k = first_[c]; k < first_[c + 1]; ++k)
                if (near(place, members_[k].place)) visit(members_[k].number);
            int axis = 0;
            while (axis < D && ++cell[axis] > upper[axis]) cell[axis] = lower[axis], ++axis;
            if (axis == D) return;
        }
    }

private:
    struct Member {
        int number;
        Point place;
    };

    bool near(const Point& a, const Point& b) const {
        double squares = 0;
        for (int axis = 0; axis < D; ++axis) {
            double difference = a[axis] - b[axis];
            if (period_[axis] > 0) difference -= period_[axis] * std::round(difference / period_[axis]);
            squares += difference * difference;
        }
        return squares < near_enough_;
    }
    std::array<int, D> place_of(const Point& point) const {
        std::array<int, D> place;
        for (int axis = 0; axis < D; ++axis) {
            const double cell = std::floor((point[axis] - origin_[axis]) / width_[axis]);
            place[axis] = int(std::clamp(cell, -1e6, 1e6));
        }
        return place;
    }
    int wrapped(int cell, int axis) const {
        const int count = count_[axis];
        return period_[axis] > 0 ? (cell % count + count) % count : std::clamp(cell, 0, count - 1);
    }
    int index(const std::array<int, D>& place) const {
        int index = place[0];
        for (int axis = 1; axis < D; ++axis) index = index * count_[axis] + place[axis];
        return index;
    }

    double near_enough_;
    std::array<int, D> count_;
    Point period_, origin_, width_;
    std::vector<int> first_;
    std::vector<Member> members_;
};

}  // namespace cortado
