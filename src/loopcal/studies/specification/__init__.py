# SPDX-License-Identifier: Apache-2.0
"""What a study is: levels of factors, cells, keys of blocks, columns of scores."""
