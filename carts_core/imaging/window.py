"""The part of an image that is compared; the network runs on nothing else."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Window:
    """A part of the working image [px]."""

    left: int
    top: int
    width: int
    height: int

    @property
    def area(self) -> int:
        """Number of pixels."""
        return self.width * self.height

    @staticmethod
    def around(silhouette: Float[Tensor, "cameras h w"], margin: int, multiple: int, size: tuple[int, int]) -> "Window":
        """What holds the silhouettes of all cameras with a margin, in multiples of a size; all where they are empty."""
        covered = silhouette.amax(0) > 0
        columns, rows = covered.any(0).nonzero()[:, 0], covered.any(1).nonzero()[:, 0]
        if not len(columns):
            return Window(0, 0, *size)
        spans = []
        for index, length in ((columns, size[0]), (rows, size[1])):
            first = max(int(index[0]) - margin, 0) // multiple * multiple
            last = min(-(-(int(index[-1]) + 1 + margin) // multiple) * multiple, length)
            spans.append((first, last - first))
        return Window(spans[0][0], spans[1][0], spans[0][1], spans[1][1])

    def holds(self, other: "Window") -> bool:
        """Whether another window lies within this one."""
        return (
            self.left <= other.left
            and self.top <= other.top
            and self.left + self.width >= other.left + other.width
            and self.top + self.height >= other.top + other.height
        )

    def common(self, other: "Window") -> "Window | None":
        """What lies in both; None if nothing does."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        right = min(self.left + self.width, other.left + other.width)
        bottom = min(self.top + self.height, other.top + other.height)
        return Window(left, top, right - left, bottom - top) if left < right and top < bottom else None

    def inside(self, outer: "Window") -> "Window":
        """This window as a part of one that holds it."""
        return Window(self.left - outer.left, self.top - outer.top, self.width, self.height)

    def reduced(self, factor: int) -> "Window":
        """This part of an image that is so many times smaller."""
        return Window(self.left // factor, self.top // factor, self.width // factor, self.height // factor)

    def of(self, image: Float[Tensor, "*batch h w"]) -> Float[Tensor, "*batch {self.height} {self.width}"]:
        """This part of an image."""
        return image[..., self.top : self.top + self.height, self.left : self.left + self.width]

    def paste(self, part: Float[Tensor, "*batch h w"], whole: Float[Tensor, "*batch H W"]) -> Tensor:
        """`whole` with this part of it replaced, in place."""
        self.of(whole)[...] = part
        return whole
