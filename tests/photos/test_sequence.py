"""The order in which photos are joined."""

import pytest

from skyquilt.errors import SideFileError
from skyquilt.photos.sequence import sequence_of

NAMES = ["b/IMG_10.jpg", "b/IMG_2.jpg", "a/IMG_30.jpg", "b/IMG_1.jpg"]


def test_time_is_the_order_they_come_in():
    assert sequence_of(NAMES, "time") == [0, 1, 2, 3]


def test_names_are_counted_as_people_count():
    assert sequence_of(NAMES, "name") == [2, 3, 1, 0]


def test_a_file_says_it(tmp_path):
    path = tmp_path / "order.txt"
    path.write_text("# from the left\nIMG_1.jpg\nimg_30\nb/IMG_10.jpg\n")
    assert sequence_of(NAMES, str(path)) == [3, 2, 0]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is empty"),
        ("IMG_9.jpg\nIMG_1.jpg\n", "names IMG_9.jpg"),
        ("IMG_1.jpg\nimg_1\n", "more than once"),
    ],
)
def test_what_is_wrong_with_the_file(tmp_path, text, says):
    path = tmp_path / "order.txt"
    path.write_text(text)
    with pytest.raises(SideFileError, match=says):
        sequence_of(NAMES, str(path))


def test_neither_word_nor_file():
    with pytest.raises(SideFileError, match="cannot be read"):
        sequence_of(NAMES, "backwards")
